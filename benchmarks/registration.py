"""Does ``overfly check`` foretell what can be mapped, and does it name what was done to a flight?

    python benchmarks/registration.py --out outputs/registration

Rendered flights with GPS noise, some of them spoilt (little overlap, missing frames, blur, faded or black pictures) are
checked, then their cameras are estimated. AUC: of expected shares of placed images against flights of which at least
95 % were placed. Then eight faults are injected into good flights, each by itself: a check is right if the worst
finding that the untouched flight does not have names the cause. Last, flights of every path without any fault are
checked, whole and without every second image, and with one position 44 m off in any direction: GPS must be blamed in
the last case alone, and the right image. Photographs and placements are kept.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageFilter
from scipy.stats import mannwhitneyu

from overfly.errors import InputError
from overfly.files import replacing
from overfly.flights import PATHS, Flight, Gps, fly, read_flight
from overfly.mapping.map import align_flight
from overfly.preflight.check import check_flight
from overfly.preflight.ground import place
from overfly.preflight.images import Look, look_at_all
from overfly.preflight.positions import position_findings
from overfly.shipped import load_network
from overfly.tables import markdown

STYLES = ("campus", "blocks", "suburb", "industrial", "village", "vegetation")
OVERLAPS = (30, 50, 65, 80)
PLACED = 0.95
Change = Callable[[Image.Image], Image.Image]


def rewrite(path: Path, change: Change) -> None:
    """Change the pixels of a photograph, not its metadata."""
    with Image.open(path) as image:
        exif, xmp = image.info["exif"], image.info["xmp"]
        changed = change(image.convert("RGB"))
    with replacing(path) as temporary:
        changed.save(temporary, "JPEG", quality=95, subsampling=0, exif=exif, xmp=xmp)


def blur(radius: float) -> Change:
    return lambda image: image.filter(ImageFilter.GaussianBlur(radius))


def scaled(factor: float, towards: float, seed: int) -> Change:
    """Grey values drawn towards one value, below a sensor's noise: fog and snow, or night."""

    def change(image: Image.Image) -> Image.Image:
        noise = np.random.default_rng(seed).normal(size=(image.height, image.width, 3))
        values = towards + factor * (np.asarray(image, float) - towards) + noise
        return Image.fromarray(np.clip(values, 0, 255).astype(np.uint8))

    return change


def flight_of(out: Path, style: str, seed: int, path: str, overlap: float, frames: int = 12) -> list[Path]:
    """The photographs of a rendered flight, without the cameras beside them."""
    fly(style, out=out / "full", flight_path=path, overlap=overlap, side_overlap=max(overlap, 15), altitude=120,
        width=480, height=360, frames=frames, seed=seed, noise="gps", reference_points=0)  # fmt: skip
    return fresh(out)


def fresh(out: Path) -> list[Path]:
    """The photographs of a rendered flight as they were taken."""
    shutil.rmtree(out / "photos", ignore_errors=True)
    shutil.copytree(out / "full" / "images", out / "photos")
    return sorted((out / "photos").iterdir())


def spoil(photos: list[Path], rng: np.random.Generator) -> str:
    """Do one thing to a flight; returns what."""
    kind = str(rng.choice(["nothing", "nothing", "blur", "fade", "dark", "missing"]))
    chosen = [p for p in photos if rng.random() < rng.choice([0.3, 0.6, 1.0])]
    strength = float(rng.uniform())
    for k, path in enumerate(chosen if kind != "nothing" else []):
        if kind == "blur":
            rewrite(path, blur(1 + 5 * strength))
        elif kind == "fade":
            rewrite(path, scaled(0.01 + 0.2 * strength**2, 200, k))
        elif kind == "dark":
            rewrite(path, scaled(0.005 + 0.1 * strength**2, 0, k))
        elif len(chosen) < len(photos) - 2:
            path.unlink()
    return f"{kind} {strength:.2f} of {len(chosen)}" if kind != "nothing" else kind


def outcome(out: Path, number: int) -> dict[str, Any]:
    """Check and placement of one flight; photographs and placement are kept, the check is always made anew."""
    folder, kept = out / f"flight-{number:03d}", out / f"flight-{number:03d}.json"
    if not kept.is_file():
        rng = np.random.default_rng([7, number])
        style, path = STYLES[number % len(STYLES)], str(rng.choice(["grid", "grid", "circular"]))
        overlap = float(rng.choice([10, 15, 20, 25, 30, 40, 50, 60, 75]))
        photos = flight_of(folder, style, 2000 + number, path, overlap)
        row: dict[str, Any] = {"style": style, "path": path, "overlap": overlap, "done": spoil(photos, rng)}
        count = len(list((folder / "photos").iterdir()))
        try:
            _, block = align_flight(
                folder / "photos",
                out=folder / "map",
                cameras="estimate",
                network=load_network,
                network_name="shipped",
                progress=False,
            )
            row |= {"images": count, "placed": (len(block.frames) - len(block.held_by_gps)) / count, "why": ""}
        except InputError as error:
            row |= {"images": count, "placed": 0.0, "why": str(error).split(":")[0]}
        shutil.rmtree(folder / "map", ignore_errors=True)
        kept.write_text(json.dumps(row) + "\n")
    check = check_flight(folder / "photos")
    return {**json.loads(kept.read_text()), "expected": float(check.chances.mean()), "verdict": check.verdict}


def auc(scores: np.ndarray, good: np.ndarray) -> float:
    """The chance that a good flight has a higher score than a bad one; ties count half."""
    return float(mannwhitneyu(scores[good], scores[~good]).statistic / (good.sum() * (~good).sum()))


FAULTS = ("blur", "exposure", "texture", "duplicates", "gps", "files", "overlap", "cameras")
"""Topics of the findings that name them."""


def inject(fault: str, photos: list[Path]) -> None:
    """Bring one fault about in a flight."""
    middle, few = photos[len(photos) // 2], photos[2::5]
    pixels = {"blur": blur(3), "exposure": scaled(3.0, 0, 0), "texture": scaled(0.01, 180, 0)}
    pixels["cameras"] = lambda image: image.crop((40, 30, image.width - 40, image.height - 30))
    if fault in pixels:
        for path in few:
            rewrite(path, pixels[fault])
    elif fault == "duplicates":
        for path in few:
            shutil.copy(path, path.with_name(f"{path.stem}_copy.jpg"))
    elif fault == "files":
        middle.write_bytes(middle.read_bytes()[:3000])
    elif fault == "overlap":
        for path in photos[1::2]:
            path.unlink()
    else:
        lines = ["EPSG:4326"]
        for frame in read_flight(photos[0].parent).frames:
            assert frame.gps is not None
            north = frame.gps.latitude + (4e-4 if frame.name == middle.name else 0.0)  # 44 m
            lines.append(f"{frame.name} {frame.gps.longitude:.8f} {north:.8f} {frame.gps.altitude}")
        (photos[0].parent / "geo.txt").write_text("\n".join(lines) + "\n")


def named(out: Path, number: int) -> dict[str, bool]:
    """For each fault, whether the check of a good flight with it names it before all that is new."""
    folder, result = out / f"faults-{number:03d}", {}
    style = STYLES[number % len(STYLES)]
    flight_of(folder, style, 3000 + number, "grid", 65, frames=20)
    usual = {(finding.topic, finding.level) for finding in check_flight(folder / "photos").findings}
    for fault in FAULTS:
        inject(fault, fresh(folder))
        findings = check_flight(folder / "photos").findings
        new = [finding for finding in findings if (finding.topic, finding.level) not in usual]
        # Missing images are gaps as well as too little overlap.
        result[fault] = bool(new) and new[0].topic in {fault, "gaps" if fault == "overlap" else fault}
        if not result[fault]:
            print(style, fault, [str(finding) for finding in new])
    return result


def blamed(flight: Flight, looks: list[Look]) -> set[str]:
    """Names of the images whose positions are called wrong."""
    findings = position_findings(flight, place(flight, looks, None), looks)
    return {name for finding in findings if finding.topic == "gps" for name in finding.images}


def alarms(out: Path, number: int) -> dict[str, Any]:
    """Blame for GPS in a flight without a fault, in its every second image, and with one position 44 m off."""
    rng = np.random.default_rng([8, number])
    path, overlap = PATHS[number % len(PATHS)], float(OVERLAPS[number // len(PATHS) % len(OVERLAPS)])
    style, folder = str(rng.choice(STYLES)), out / f"healthy-{number:03d}"
    flight_of(folder, style, 4000 + number, path, overlap, frames=int(rng.integers(14, 34)))
    flight = read_flight(folder / "photos")
    looks, frames = look_at_all([frame.path for frame in flight.frames]), flight.frames
    row: dict[str, Any] = {"style": style, "path": path, "overlap": overlap, "images": len(frames)}
    row |= {"false": bool(blamed(flight, looks)), "false_halved": False, "errors": 0, "named": 0, "others": 0}
    if len(frames) >= 12:
        row["false_halved"] = bool(blamed(replace(flight, frames=frames[::2]), looks[::2]))
    for i in sorted({0, 1, len(frames) // 3, len(frames) // 2, len(frames) - 1}) if len(frames) >= 8 else ():
        gps, angle = frames[i].gps, rng.uniform(0, 2 * np.pi)
        assert gps is not None
        north, east = 4e-4 * np.cos(angle), 4e-4 * np.sin(angle) / np.cos(np.radians(gps.latitude))  # 44 m
        wrong = replace(frames[i], gps=Gps(gps.latitude + north, gps.longitude + east, gps.altitude))
        told = blamed(replace(flight, frames=[*frames[:i], wrong, *frames[i + 1 :]]), looks)
        row["errors"] += 1
        row["named"] += frames[i].name in told
        row["others"] += bool(told - {frames[i].name})
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/registration"))
    parser.add_argument("--flights", type=int, default=60)
    parser.add_argument("--first", type=int, default=0, help="number of the first flight: other flights, another test")
    parser.add_argument("--faulty", type=int, default=6, help="good flights into which the faults are injected")
    parser.add_argument("--healthy", type=int, default=16, help="flights without a fault, in which none may be told")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = [outcome(asked.out, number) for number in range(asked.first, asked.first + asked.flights)]
    right = [named(asked.out, number) for number in range(asked.faulty)]
    quiet = [alarms(asked.out, number) for number in range(asked.healthy)]
    print(markdown(rows))
    if rows:
        good = np.array([row["placed"] >= PLACED for row in rows])
        expected = np.array([row["expected"] for row in rows])
        off = np.abs(expected - [row["placed"] for row in rows])
        print(f"\n{good.sum()} of {len(good)} flights placed; AUC {auc(expected, good):.3f}")
        print(f"Mean error of the expected share: {off.mean():.3f}")
    if right:
        shares = {topic: f"{sum(r[topic] for r in right)} of {len(right)}" for topic in right[0]}
        print(f"Named causes: {shares}; {np.mean([list(r.values()) for r in right]):.0%} right")
    if quiet:
        print(markdown(quiet))
        total = {key: sum(row[key] for row in quiet) for key in ("false", "false_halved", "errors", "named", "others")}
        print(f"\nGPS blamed in {len(quiet)} flights without a fault: {total}")


if __name__ == "__main__":
    main()
