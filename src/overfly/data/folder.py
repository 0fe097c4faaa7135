"""The user's own flights as training data: a flight folder with images, cameras and a reference cloud."""

from __future__ import annotations

import hashlib
import json
import logging
import zlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from overfly.data.record import Record, cached
from overfly.data.windows import resample, window_camera
from overfly.errors import InputError
from overfly.flights import Flight, Frame, read_flight
from overfly.scenes import Renderer, Scene, load_scene

log = logging.getLogger("overfly")


class FolderFlights:
    """Records of flight folders; every value comes from conf/data/folder.yaml.

    The frames of a flight are shared out in order: the first are trained on, the next validated, the last tested, so
    that a split does not look at the same ground from the same place as another.
    """

    def __init__(
        self,
        *,
        root: str | Sequence[str],
        reference: str | None,
        val_share: float,
        test_share: float,
        image_size: Sequence[int],
        cache_dir: str,
    ) -> None:
        self.roots = [Path(path).expanduser() for path in ([root] if isinstance(root, str) else root)]
        if not (0 < val_share < 1 and 0 <= test_share < 1 and val_share + test_share < 1):
            raise InputError(
                f"val_share={val_share} and test_share={test_share} leave nothing to train on: "
                "give shares that add up to less than 1, such as 0.2 and 0.2."
            )
        self.reference = reference
        self.val_share, self.test_share = val_share, test_share
        self.image_size = (int(image_size[0]), int(image_size[1]))
        self.folder = Path(cache_dir).expanduser() / "folders"

    def has(self, split: str) -> bool:
        return split in ("train", "val") or (split == "test" and self.test_share > 0)

    def prepare(self, split: str, limit: int | None = None) -> list[Path]:
        """The records of a split, made from the images where they are not in the cache.

        Raises:
            InputError: a flight has no cameras or no reference, or too few frames.
        """
        return [self._prepare(root, split, scene) for scene, root in enumerate(self.roots[:limit])]

    def _prepare(self, root: Path, split: str, scene: int) -> Path:
        flight = read_flight(root)
        frames = self._frames(flight, split)
        reference = Path(self.reference) if self.reference else flight.reference
        if reference is None:
            raise InputError(
                f"{root} has no reference cloud to learn from: put reference.laz (or .ply) in the folder, in the "
                f"cameras' frame, or give data.source.reference=...; `overfly map {root} --out OUT` makes a cloud."
            )
        cameras = (*root.glob("*.json"), *root.glob("geo.txt"), *root.glob("sparse/*.*"), *root.glob("sparse/0/*.*"))
        files = [*(frame.path for frame in frames), reference, *sorted(cameras)]
        facts = [(str(file.resolve()), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
        content = json.dumps([facts, self.image_size, split, scene, "2"])
        folder = self.folder / hashlib.sha256(content.encode()).hexdigest()[:20]
        return cached(folder, lambda: self._record(flight, frames, reference, scene))

    def _frames(self, flight: Flight, split: str) -> list[Frame]:
        frames = [f for f in flight.frames if f.camera is not None and f.world_from_camera is not None]
        if not frames:
            raise InputError(
                f"{flight.root} has no cameras (no transforms.json, sparse/0 or reconstruction.json): "
                f"type `overfly map {flight.root} --out OUT` first and copy OUT/transforms.json into it."
            )
        n = len(frames)
        # A window of one frame sees no depth: each split gets two at least.
        test, val = (max(2, round(n * share)) if share else 0 for share in (self.test_share, self.val_share))
        bounds = {"train": (0, n - val - test), "val": (n - val - test, n - test), "test": (n - test, n)}
        first, last = bounds[split]
        if last - first < 2 or first < 0:
            raise InputError(
                f"{flight.root} has {n} frames with cameras, which leaves {max(0, last - first)} for {split} of 2 that "
                "are needed: give a larger flight or smaller data.source.val_share and test_share."
            )
        return frames[first:last]

    def _record(self, flight: Flight, frames: list[Frame], reference: Path, number: int) -> Record:
        log.info("Reading %d frames of %s", len(frames), flight.root)
        scene = load_scene(reference)
        cameras, images, depth, poses = [], [], [], []
        shift = _shift(scene, flight)
        renderer = Renderer(scene)
        for frame in frames:
            assert frame.camera is not None
            assert frame.world_from_camera is not None
            camera = window_camera(frame.camera, *self.image_size)
            pose = frame.world_from_camera.copy()
            pose[:3, 3] -= shift
            images.append(resample(frame.image(), frame.camera, camera))
            depth.append(renderer.depth(camera, pose))
            cameras.append(camera)
            poses.append(pose)
        seen = np.mean([(d > 0).mean() for d in depth])
        if seen < 0.1:
            raise InputError(
                f"The cameras of {flight.root} see {seen:.0%} of the reference {reference.name}: they are not in the "
                "same frame of reference; give a reference in the cameras' frame."
            )
        low, high = scene.bounds
        ground = scene.ground(np.array(poses)[:, :2, 3])
        height = float(np.nanmean(ground))
        cell = float(np.median([p[2, 3] - height for p in poses]) / cameras[0].fx / 2)
        return Record(
            images=np.stack(images),
            depth=np.stack(depth).astype(np.float32),
            world_from_camera=np.stack(poses),
            cameras=cameras,
            strips=np.zeros(len(frames), np.int64),
            heights=renderer.height_map(float(low[0]), float(low[1]), float(high[0]), float(high[1]), cell),
            corner=(float(low[0]), float(high[1]), cell),
            ground_height=height,
            facts={
                "scene": number,
                "style": flight.root.name,
                "seed": zlib.crc32(flight.root.name.encode()),
                "altitude": float(np.median([p[2, 3] - height for p in poses])),
                "flight_path": flight.facts.get("flight_path"),
            },
        )


def _shift(scene: Scene, flight: Flight) -> NDArray[np.float64]:
    """What to take from the cameras' positions to bring them into the scene's local frame [3].

    A scene read from a file with a CRS stands around its own origin; one without a CRS keeps the file's coordinates.
    """
    if scene.origin is None:
        return np.zeros(3)
    if flight.origin is None:
        raise InputError(
            f"The reference has a CRS, but the cameras of {flight.root} have no geographic origin: "
            "give a reference in the cameras' local frame."
        )
    from overfly.geodesy import enu_from_geodetic

    place = scene.origin
    # Both frames point east, north, up; over one flight the axes of two places differ by less than 1 mm a metre.
    return enu_from_geodetic([[place.latitude, place.longitude, place.height]], flight.origin)[0]
