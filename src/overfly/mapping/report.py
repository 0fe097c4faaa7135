"""``report.html``: what a surveyor wants to know about a map, at a look, in one file that needs nothing else."""

from __future__ import annotations

import base64
import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from overfly import __version__
from overfly.files import replacing
from overfly.mapping.gaps import SOURCES
from overfly.mapping.heights import heights_text


@dataclass(frozen=True)
class Caution:
    """Something that the user should know before trusting the map, and what to do about it."""

    what: str
    advice: str

    def __str__(self) -> str:
        return f"{self.what} {self.advice}"


@dataclass(frozen=True)
class Picture:
    """A picture of the report: bytes of a PNG or JPEG file."""

    section: str
    title: str
    caption: str
    data: bytes

    @property
    def kind(self) -> str:
        return "png" if self.data.startswith(b"\x89PNG") else "jpeg"


FILES = {
    "cloud.laz": "the point cloud: colour, confidence, sigma_m, views, predicted",
    "cloud.ply": "the same for mesh programs",
    "dsm.tif": "surface heights (GeoTIFF)",
    "dsm_source.tif": "which of them are measured, predicted or interpolated (GeoTIFF, values 1, 2, 3)",
    "orthophoto.tif": "colours seen from straight above (GeoTIFF)",
    "mesh.glb": "the surface as a mesh, textured from the photographs (glTF, local coordinates)",
    "transforms.json": "the cameras used, in local metres east, north, up",
    "map.json": "the numbers of this report for programs",
}


def write_report(
    path: Path,
    *,
    title: str,
    summary: Mapping[str, Any],
    pictures: Sequence[Picture],
    cautions: Sequence[Caution],
    settings: Mapping[str, Any],
    written: Sequence[str] = (),
) -> None:
    """Write the report, atomically.

    Args:
        path: the HTML file.
        title: the flight's name.
        summary: the content of ``map.json``.
        pictures: in the order in which they appear; those of one section stand side by side.
        cautions: warnings, each with what to do.
        settings: what the map was asked for.
        written: names of the files beside the report.
    """
    from jinja2 import Environment

    template = files("overfly.mapping").joinpath("report.html.j2").read_text(encoding="utf-8")
    environment = Environment(autoescape=True, trim_blocks=False, keep_trailing_newline=True)
    unit = "m" if summary["metric"] else "units"
    seconds: Mapping[str, float] = summary["seconds"]
    longest = max([*seconds.values(), 1e-9])
    reused = set(summary.get("reused", ()))
    sections: dict[str, list[dict[str, str]]] = {}
    for picture in pictures:
        data = base64.b64encode(picture.data).decode()
        figure = {"title": picture.title, "caption": picture.caption, "kind": picture.kind, "data": data}
        sections.setdefault(picture.section, []).append(figure)
    page = environment.from_string(template).render(
        title=title,
        made=datetime.datetime.now().strftime("%Y-%m-%d %H:%M"),
        verdict=verdict(summary),
        tiles=_tiles(summary, unit),
        warnings=cautions,
        sections=[{"title": name, "figures": figures} for name, figures in sections.items()],
        accuracy=_accuracy(summary, unit),
        frames=_missing(summary),
        steps=[
            {
                "name": name,
                "time": duration(value),
                "percent": round(100 * value / longest, 1),
                "reused": name in reused,
            }
            for name, value in seconds.items()
        ],
        total=duration(sum(seconds.values())),
        memory=f"{summary['peak_memory_mb'] / 1024:.1f} GB",
        settings=[{"label": k, "value": "–" if v is None else v} for k, v in settings.items()],
        files=[{"name": n, "what": FILES[n] + _about_mesh(summary, n)} for n in written if n in FILES],
        version=__version__,
        unit_name="metres" if summary["metric"] else "units of unknown length",
        crs=summary["crs"],
        heights=heights_text(summary["heights"]),
    )
    with replacing(path) as temporary:
        temporary.write_text(page, encoding="utf-8")


def verdict(summary: Mapping[str, Any]) -> str:
    """The map in one or two sentences."""
    placed, images = summary["registered"], summary["images"]
    text = f"{'All' if placed == images else placed} {'' if placed == images else 'of '}{images} images were placed"
    if summary["metric"]:
        text += f" and {area_text(summary['area'])} mapped with {count_text(summary['points'])} points"
        text += f" at {length_text(summary['gsd_m'])} per pixel."
    else:
        text += f" and mapped with {count_text(summary['points'])} points, in units of unknown length:"
        text += " neither GPS nor an origin tells the size, only the shape is known."
    share = summary["predicted"] / max(summary["points"], 1)
    if share >= 0.005:
        text += f" {share:.0%} of the points are predicted, not measured: no two images agree on them."
    return text


def _tiles(summary: Mapping[str, Any], unit: str) -> list[dict[str, str]]:
    all_placed = summary["registered"] == summary["images"]
    mapped = area_text(summary["area"]) if summary["metric"] else "unknown"
    density = density_text(summary["points_per_area"])
    low, high = summary["height_range"]
    measured = summary["measured"] / max(summary["points"], 1)
    tiles = [
        ("images placed", f"{summary['registered']} of {summary['images']}", "" if all_placed else "bad"),
        ("area", mapped, ""),
        ("ground sampling distance", length_text(summary["gsd_m"]) if summary["metric"] else "unknown", ""),
        ("points", count_text(summary["points"]), ""),
        ("points per m²" if summary["metric"] else "points per unit²", density, ""),
        ("measured in two or more images", f"{measured:.1%}", "" if measured > 0.9 else "warn"),
        (f"heights ({unit}), 1 to 99 %", f"{low:.1f} … {high:.1f}", ""),
        ("coordinate system", summary["crs"] or ("local frame" if summary["metric"] else "none, scale unknown"), ""),
    ]
    return [{"label": label, "value": value, "mood": mood} for label, value, mood in tiles]


def _accuracy(summary: Mapping[str, Any], unit: str) -> list[dict[str, str]]:
    rows = _surveyed(summary)
    if (pixels := summary.get("reprojection_px")) is not None:
        rows.append(
            ("Reprojection error", f"{pixels:.2f} px", "below 1 px is good; above 1.5 px look for blurred images")
        )
    if gps := summary.get("gps_rms"):
        horizontal, vertical = gps["horizontal_m"], gps["vertical_m"]
        note = "how far the cameras lie from their own GPS after the fit; without RTK 1 to 3 m are normal"
        rows.append(("Cameras to GPS, horizontal (RMS)", f"{horizontal:.2f} m", note))
        if vertical is not None:
            rows.append(
                ("Cameras to GPS, vertical (RMS)", f"{vertical:.2f} m", "a constant error of height is not in this")
            )
    if summary.get("median_sigma") is not None:
        rows.append(
            (
                "Estimated sigma of a point (median)",
                f"{summary['median_sigma']:.3f} {unit}",
                "per point in the cloud as sigma_m; relative to the block, without the error of GPS",
            )
        )
    rows.append(
        (
            "Points measured / predicted",
            f"{count_text(summary['measured'])} / {count_text(summary['predicted'])}",
            "on predicted points no two images agree: do not measure on them",
        )
    )
    if (surface := summary.get("surface")) is not None:
        shares = " / ".join(f"{surface[name]:.0%}" for name in SOURCES.values())
        what = "of the surface model measured / predicted / interpolated: dsm_source.tif tells where"
        rows.append(("Surface model", shares, what))
    if summary["metric"]:
        estimated = summary["cameras_from"] == "estimated"
        ruled = bool((summary.get("ground_control") or {}).get("controls"))
        how = "from ground control" if ruled else "from the GPS of the images"
        how = how if estimated or ruled else f"as given by {summary['cameras_from']}"
        rows.append(("Metric scale", "known", how))
    else:
        rows.append(("Metric scale", "unknown", "no GPS, no origin: measure a known distance and scale by it"))
    if summary["crs"] and not (summary.get("ground_control") or {}).get("controls"):
        rows.append(
            (
                "Absolute height",
                "as good as the GPS",
                "heights as a whole may be off by metres; use ground control if it matters",
            )
        )
    return [{"label": label, "value": value, "note": note} for label, value, note in rows]


def _surveyed(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Check points first, then what held the map, then the cameras' precision."""
    rows: list[tuple[str, str, str]] = []
    ground = summary.get("ground_control") or {}
    notes = {
        "checks": "never used in the adjustment: the accuracy of the map where it is controlled",
        "controls": "they hold the map, so that they flatter it; weighed by their own spread",
    }
    for kind, label in (("checks", "Check points"), ("controls", "Control points")):
        if rms := ground.get(kind):
            value = f"{rms['x_m']:.3f} / {rms['y_m']:.3f} / {rms['z_m']:.3f} m"
            rows.append((f"{label} ({rms['points']}), RMS east / north / up", value, notes[kind]))
    if ground and not ground.get("checks"):
        rows.append(("Check points", "none", "nothing checks the map: give four control points or more"))
    for point in ground.get("points", ()):
        if point["residual"] is not None:
            value = " / ".join(f"{v:+.3f}" for v in point["residual"]) + " m"
            rows.append(
                (f"{point['name']} ({point['role']})", value, f"{point['pixels']:.1f} px in {point['images']} images")
            )
    if shift := ground.get("gps_shift_m"):
        value = " / ".join(f"{v:+.2f}" for v in shift) + " m"
        rows.append(("GPS against ground control, east / north / up", value, "the map follows the controls"))
    precision = summary.get("precision") or {}
    if "horizontal_m" in precision:
        h, v, r = (precision[k] for k in ("horizontal_m", "vertical_m", "rotation_deg"))
        rows.append(
            (
                "Camera positions, standard deviation (median, worst)",
                f"{h['median']:.3f} m ({h['worst']:.3f}), up {v['median']:.3f} m ({v['worst']:.3f})",
                f"from the adjustment; directions {r['median']:.3f}° ({r['worst']:.3f}°)",
            )
        )
    elif why := precision.get("why_not"):
        rows.append(("Camera positions, standard deviation", "unknown", why))
    return rows


def _about_mesh(summary: Mapping[str, Any], name: str) -> str:
    if name != "mesh.glb" or not (mesh := summary.get("mesh")):
        return ""
    x, y, z = (f"{value:.0f}" for value in mesh["origin"])
    return (
        f"; {count_text(mesh['faces'])} triangles; {mesh['textured_share']:.0%} of the surface shows photographs, "
        f"the rest the cloud's colours; {mesh['filled_share']:.0%} of its plan closes gaps without points; its origin "
        f"is {x}, {y}, {z}"
    )


def _missing(summary: Mapping[str, Any]) -> list[dict[str, str]]:
    rows = [{"name": n, "why": "could not be placed: too little overlap or texture"} for n in summary["unregistered"]]
    return rows + [{"name": name, "why": why} for name, why in summary["skipped"].items()]


def duration(seconds: float) -> str:
    """1.2 s, 48 s, 3 min 05 s, 2 h 10 min."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    if seconds < 120:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return (
        f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
        if seconds < 3600
        else f"{minutes // 60} h {minutes % 60:02d} min"
    )


def count_text(number: int) -> str:
    """1 234, 56.7 thousand, 1.23 million."""
    if number >= 1_000_000:
        return f"{number / 1e6:.2f} million"
    return f"{number:,}".replace(",", " ")


def density_text(density: float) -> str:
    """Two digits below ten, whole numbers above."""
    return f"{density:.2g}" if density < 10 else f"{density:,.0f}".replace(",", " ")


def length_text(metres: float) -> str:
    """Millimetres, centimetres or metres, whichever reads best."""
    return f"{metres * 100:.1f} cm" if metres < 1 else f"{metres:.2f} m"


def area_text(square_metres: float) -> str:
    """Square metres, hectares or square kilometres."""
    if square_metres < 10_000:
        return f"{square_metres:,.0f} m²".replace(",", " ")
    return f"{square_metres / 1e4:.2f} ha" if square_metres < 1e6 else f"{square_metres / 1e6:.2f} km²"
