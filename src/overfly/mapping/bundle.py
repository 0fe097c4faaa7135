"""A bundle: cameras, points and the rays between them, as arrays; from one or several sparse models."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from overfly.geometry import Array, Camera, pose, transform

Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Bundle:
    """Cameras, points and the rays between them, all in one frame of reference.

    Attributes:
        frames: index of each image's frame in the flight, ascending [n].
        rotations: camera-from-world [n, 3, 3].
        centres: of projection [n, 3].
        lens_of: which row of ``lenses`` each image has [n].
        lenses: focal length, principal point (pixels), k1, k2 (COLMAP's RADIAL) [c, 5].
        lens_ids: what the sparse models call them [c].
        points: [m, 3].
        image, point: which image sees which point [k], ordered by point, each pair once.
        pixels: where [k, 2].
    """

    frames: Index
    rotations: Array
    centres: Array
    lens_of: Index
    lenses: Array
    lens_ids: tuple[int, ...]
    points: Array
    image: Index
    point: Index
    pixels: Array

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def world_from_camera(self) -> Array:
        """Rotations [n, 3, 3]."""
        return self.rotations.transpose(0, 2, 1)

    def camera(self, k: int, width: int, height: int) -> Camera:
        """The calibrated camera of an image."""
        f, cx, cy, k1, k2 = (float(v) for v in self.lenses[self.lens_of[k]])
        return Camera(width, height, f, f, cx, cy, k1=k1, k2=k2)

    def pose(self, k: int) -> Array:
        """world_from_camera [4, 4] of an image."""
        return pose(self.rotations[k].T, self.centres[k])

    def project(self, points: Array, image: Index) -> Array:
        """Pixels [k, 2] of points [k, 3] in the given images [k]; NaN behind the camera."""
        local = np.einsum("kij,kj->ki", self.rotations[image], points - self.centres[image])
        with np.errstate(divide="ignore", invalid="ignore"):
            flat = np.where(local[:, 2:] > 0, local[:, :2] / local[:, 2:], np.nan)
        f, cx, cy, k1, k2 = self.lenses[self.lens_of[image]].T
        r2 = (flat**2).sum(1)
        return flat * (f * (1 + r2 * (k1 + r2 * k2)))[:, None] + np.stack([cx, cy], axis=1)

    def errors(self) -> Array:
        """Reprojection errors [k], pixels; infinite behind the camera."""
        away = np.linalg.norm(self.project(self.points[self.point], self.image) - self.pixels, axis=1)
        return np.nan_to_num(away, nan=np.inf)

    def moved(self, matrix: Array) -> Bundle:
        """In another frame: ``matrix`` is a similarity [4, 4]."""
        turn = matrix[:3, :3] / np.cbrt(np.linalg.det(matrix[:3, :3]))
        return replace(
            self,
            rotations=self.rotations @ turn.T,
            centres=transform(matrix, self.centres),
            points=transform(matrix, self.points),
        )

    def kept(self, good: NDArray[np.bool_]) -> Bundle:
        """Without the rays that are not ``good`` [k], and without points that less than two are left of."""
        seen = np.bincount(self.point[good], minlength=len(self.points))
        good = good & (seen[self.point] >= 2)
        number = np.cumsum(seen >= 2) - 1
        return replace(
            self,
            points=self.points[seen >= 2],
            image=self.image[good],
            point=number[self.point[good]],
            pixels=self.pixels[good],
        )

    def without(self, images: NDArray[np.bool_]) -> Bundle:
        """Without some images [n], what only they and one other see, and lenses that only they have."""
        kept = self.kept(~images[self.image])
        number = np.cumsum(~images) - 1
        used, lens_of = np.unique(self.lens_of[~images], return_inverse=True)
        return replace(
            kept,
            frames=self.frames[~images],
            rotations=self.rotations[~images],
            centres=self.centres[~images],
            lens_of=lens_of.reshape(-1),
            lenses=self.lenses[used],
            lens_ids=tuple(self.lens_ids[i] for i in used.tolist()),
            image=number[kept.image],
        )

    def links(self) -> dict[tuple[int, int], int]:
        """How many points two images have in common, for pairs of images i < j that have any."""
        from scipy.sparse import csr_array

        sees = csr_array((np.ones(len(self.image)), (self.image, self.point)), shape=(len(self), len(self.points)))
        common = (sees @ sees.T).tocoo()
        upper = common.row < common.col
        rows = zip(common.row[upper].tolist(), common.col[upper].tolist(), common.data[upper].tolist(), strict=True)
        return {(i, j): int(count) for i, j, count in sorted(rows)}


def bundle_of(model: Any, number: Mapping[str, int]) -> Bundle:
    """The bundle of a pycolmap reconstruction; ``number`` is the index in the flight of each frame's name."""
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda image: number[image.name])
    lens_ids = tuple(sorted({image.camera_id for image in images}))
    rays = []
    for k, image in enumerate(images):
        seen = image.get_observation_points2D()
        if seen:
            xy = np.array([p.xy for p in seen])
            rays.append(np.column_stack([np.full(len(seen), k), [p.point3D_id for p in seen], xy]))
    rows = np.concatenate(rays) if rays else np.zeros((0, 4))
    ids, place = np.unique(rows[:, 1].astype(np.int64), return_inverse=True)
    _, first = np.unique(place * len(images) + rows[:, 0].astype(np.int64), return_index=True)  # by point, then image
    return Bundle(
        frames=np.array([number[image.name] for image in images], np.intp),
        rotations=np.stack([image.cam_from_world().rotation.matrix() for image in images]),
        centres=np.array([image.projection_center() for image in images]),
        lens_of=np.array([lens_ids.index(image.camera_id) for image in images], np.intp),
        lenses=np.stack([np.array(model.cameras[i].params, float) for i in lens_ids]),
        lens_ids=lens_ids,
        points=np.array([model.points3D[i].xyz for i in ids.tolist()]).reshape(-1, 3),
        image=rows[first, 0].astype(np.intp),
        point=place[first].astype(np.intp),
        pixels=rows[first, 2:],
    ).kept(np.ones(len(first), bool))


def components(bundle: Bundle) -> list[Bundle]:
    """Parts of a bundle that have no point in common, the largest first."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n, m = len(bundle), len(bundle.points)
    joined = coo_array((np.ones(len(bundle.image)), (bundle.image, n + bundle.point)), shape=(n + m, n + m))
    part = connected_components(joined, directed=False)[1][:n]
    labels, sizes = np.unique(part, return_counts=True)
    return [bundle.without(part != label) for label in labels[np.argsort(-sizes, kind="stable")]]


def merged(parts: Sequence[Bundle]) -> Bundle:
    """Bundles without common images, in one; a camera that several have is calibrated as in the largest of them."""
    if len(parts) == 1:
        return parts[0]
    lens_ids = tuple(sorted({i for part in parts for i in part.lens_ids}))
    lenses = np.zeros((len(lens_ids), 5))
    for part in sorted(parts, key=len):
        for row, i in zip(part.lenses, part.lens_ids, strict=True):
            lenses[lens_ids.index(i)] = row
    frames = np.concatenate([part.frames for part in parts])
    order = np.argsort(frames, kind="stable")
    rank = np.argsort(order)
    starts = np.cumsum([0, *(len(part) for part in parts)])
    ends = np.cumsum([0, *(len(part.points) for part in parts)])
    lens_of = [np.array([lens_ids.index(part.lens_ids[i]) for i in part.lens_of], np.intp) for part in parts]
    return Bundle(
        frames=frames[order],
        rotations=np.concatenate([part.rotations for part in parts])[order],
        centres=np.concatenate([part.centres for part in parts])[order],
        lens_of=np.concatenate(lens_of)[order],
        lenses=lenses,
        lens_ids=lens_ids,
        points=np.concatenate([part.points for part in parts]),
        image=rank[np.concatenate([part.image + start for part, start in zip(parts, starts[:-1], strict=True)])],
        point=np.concatenate([part.point + end for part, end in zip(parts, ends[:-1], strict=True)]),
        pixels=np.concatenate([part.pixels for part in parts]),
    )
