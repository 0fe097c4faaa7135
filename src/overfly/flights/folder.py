"""The flight folder: images, cameras and side files of one flight, read together."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path

from overfly.errors import InputError
from overfly.flights.exif import Facts, read_facts
from overfly.flights.flight import Flight, Frame
from overfly.flights.images import defect, list_images, natural_key
from overfly.flights.locate import located
from overfly.flights.odm import read_gcps, read_geo
from overfly.flights.remarks import altitude_remarks, listed, metadata_remarks
from overfly.flights.transforms import Cameras, read_transforms

PRODUCTS = {"dsm.tif", "dsm_source.tif", "dtm.tif", "orthophoto.tif"}
"""Results that may lie beside the images of a plain folder and are no photographs."""


def read_flight(root: Path | str) -> Flight:
    """Read a flight folder, or a plain folder of images.

    Pixels are not decoded: a file that is damaged in its middle shows up in :meth:`Frame.image`. Images that cannot be
    used are left out and named in ``warnings`` and ``skipped``.

    Args:
        root: the folder; its images lie in ``images/`` or in itself.

    Returns:
        The frames ordered by EXIF time if all have one, else by natural name order; cameras from the first of
        transforms.json, sparse/ and reconstruction.json; those of a model without an origin are brought to the images'
        GPS, or levelled (:func:`overfly.flights.locate.located`).

    Raises:
        InputError: no such folder, fewer than two usable images, broken camera or side files.
    """
    root = Path(root)
    if not root.exists():
        raise InputError(f"The flight folder {root} does not exist: check the path.")
    if not root.is_dir():
        raise InputError(f"{root} is a file: give the folder that holds the images.")
    cameras = _read_cameras(root)
    folder, paths = _find_images(root)
    if cameras is not None:
        known = {p.resolve() for p in paths}
        paths += [p for p in cameras.paths.values() if p.resolve() not in known]
    frames, facts, skipped = _read_frames(root, folder, paths)
    warnings = list(cameras.warnings) if cameras is not None else []
    if skipped:
        warnings.append(
            f"{len(skipped)} of {len(paths)} images cannot be used and are skipped: "
            f"{listed([f'{name} ({reason})' for name, reason in skipped.items()])}."
        )
    _check_count(root, frames, skipped)
    if (root / "geo.txt").is_file():
        frames = _with_geo(frames, root / "geo.txt", warnings)
    warnings += metadata_remarks(frames, facts) + altitude_remarks(frames, facts)
    order = sorted(range(len(frames)), key=lambda i: natural_key(frames[i].name))
    if all(f.time is not None for f in frames):
        order = sorted(order, key=lambda i: frames[i].time)  # type: ignore[arg-type,return-value]
    frames = [frames[i] for i in order]
    if cameras is not None:
        frames = _with_cameras(frames, folder, root, cameras, set(skipped), warnings)
    gcp_file = root / "gcp_list.txt"
    references = [root / f"reference{end}" for end in (".ply", ".las", ".laz")]
    flight = Flight(
        root=root,
        frames=frames,
        origin=cameras.origin if cameras is not None else None,
        cameras_from=cameras.source if cameras is not None else None,
        facts=cameras.facts if cameras is not None else {},
        warnings=warnings,
        skipped=skipped,
        reference=next((r for r in references if r.is_file()), None),
        gcps=read_gcps(gcp_file) if gcp_file.is_file() else [],
    )
    return located(flight)


def _read_cameras(root: Path) -> Cameras | None:
    if (root / "transforms.json").is_file():
        return read_transforms(root / "transforms.json")
    for source in ("sparse/0", "sparse"):
        model = root / source
        if any((model / f"images{end}").is_file() for end in (".bin", ".txt")):
            from overfly.flights.colmap import read_colmap

            return read_colmap(model, source)
    if (root / "reconstruction.json").is_file():
        from overfly.flights.opensfm import read_reconstruction

        return read_reconstruction(root / "reconstruction.json")
    return None


def _find_images(root: Path) -> tuple[Path, list[Path]]:
    """The folder of the images, and them."""
    for folder in sorted(p for p in root.iterdir() if p.is_dir() and p.name.lower() == "images"):
        found = list_images(folder)
        if found:
            return folder, found
    return root, [p for p in list_images(root) if p.name.lower() not in PRODUCTS]


def _check_count(root: Path, frames: list[Frame], skipped: dict[str, str]) -> None:
    if len(frames) >= 2:
        return
    if not frames and not skipped:
        below = [(p, len(list_images(p))) for p in root.iterdir() if p.is_dir()]
        better = max(below, key=lambda entry: entry[1], default=(root, 0))
        hint = f" ({better[1]} images lie in {better[0]}: give that folder)" if better[1] else ""
        raise InputError(f"{root} holds no images{hint}: put .jpg, .png or .tif files into it or into its images/.")
    reasons = f" ({listed([f'{name}: {reason}' for name, reason in skipped.items()])})" if skipped else ""
    count = "no usable image" if not frames else "only one usable image"
    raise InputError(f"{root} holds {count}{reasons}: a flight needs at least two overlapping ones.")


def _read_frames(root: Path, folder: Path, paths: list[Path]) -> tuple[list[Frame], list[Facts], dict[str, str]]:
    from PIL.Image import DecompressionBombError

    frames, facts, skipped = [], [], {}
    for path in paths:
        base = folder if path.is_relative_to(folder) else root
        name = path.relative_to(base).as_posix() if path.is_relative_to(base) else path.as_posix()
        try:
            reason = defect(path)
            found = read_facts(path) if reason is None else None
        except (OSError, SyntaxError, ValueError, DecompressionBombError) as error:
            reason, found = str(error).split("\n")[0] or "cannot be read", None
        if found is None:
            skipped[name] = reason or "cannot be read"
            continue
        facts.append(found)
        frames.append(
            Frame(
                name=name,
                path=path,
                width=found.width,
                height=found.height,
                gps=found.gps,
                relative_altitude=found.relative_altitude,
                gimbal=found.gimbal,
                time=found.time,
                make=found.make,
                model=found.model,
                focal_mm=found.focal_mm,
                focal35_mm=found.focal35_mm,
                focal_px=found.focal_px,
                lens=found.lens,
                orientation=found.orientation,
            )
        )
    return frames, facts, skipped


def _with_geo(frames: list[Frame], path: Path, warnings: list[str]) -> list[Frame]:
    entries = read_geo(path)
    names = {f.name for f in frames}
    unmatched = [name for name in entries if name not in names]
    if len(unmatched) == len(entries) and entries:
        raise InputError(f"None of the image names in {path} is in this flight ({listed(unmatched)}): correct them.")
    if unmatched:
        warnings.append(f"geo.txt names {len(unmatched)} images that are not here: {listed(unmatched)}.")
    return [
        replace(f, gps=entries[f.name].gps, gimbal=entries[f.name].gimbal or f.gimbal) if f.name in entries else f
        for f in frames
    ]


def _with_cameras(
    frames: list[Frame], folder: Path, root: Path, cameras: Cameras, skipped: set[str], warnings: list[str]
) -> list[Frame]:
    """Give frames the cameras of the file, whose names may be paths from the root, the image folder or elsewhere."""
    by_path = {path.resolve(): name for name, path in cameras.paths.items()}
    bare = Counter(Path(name).name for name in cameras.poses)
    by_name = {Path(name).name: name for name in cameras.poses if bare[Path(name).name] == 1}
    result, used = [], set()
    for frame in frames:
        name = by_path.get(frame.path.resolve())
        if name is None and not by_path:
            full = frame.path.relative_to(root).as_posix() if frame.path.is_relative_to(root) else frame.name
            name = next((n for n in (frame.name, full) if n in cameras.poses), by_name.get(Path(frame.name).name))
        if name is None:
            result.append(frame)
            continue
        used.add(name)
        camera = cameras.cameras[name]
        if (camera.width, camera.height) != (frame.width, frame.height):
            if abs(camera.width * frame.height / (camera.height * frame.width) - 1) > 0.01:
                raise InputError(
                    f"{cameras.source} says that {name} has {camera.width} x {camera.height} pixels, the image has "
                    f"{frame.width} x {frame.height}: give the images that the cameras belong to."
                )
            note = f"{cameras.source} was made for images of another size: its cameras are scaled to the images."
            if note not in warnings:
                warnings.append(note)
            camera = camera.resized(frame.width, frame.height)
        result.append(replace(frame, camera=camera, world_from_camera=cameras.poses[name]))
    if not used:
        raise InputError(
            f"None of the image names in {cameras.source} is in {folder} ({listed(sorted(cameras.poses))}): give the "
            "images that the cameras belong to, or remove the camera file."
        )
    without = [f.name for f in result if f.camera is None]
    if without:
        warnings.append(
            f"{len(without)} of {len(result)} images have no camera in {cameras.source}: {listed(without)}."
        )
    absent = [n for n in cameras.poses if n not in used and Path(n).name not in {Path(s).name for s in skipped}]
    if absent:
        warnings.append(f"{cameras.source} holds {len(absent)} images that are not here: {listed(absent)}.")
    return result
