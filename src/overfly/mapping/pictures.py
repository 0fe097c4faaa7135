"""Pictures of a map for people: from above in colour and height, the block of cameras, views, and an oblique view.

Every function returns an image as uint8 [H, W, 3]; :func:`png` turns it into the bytes of a file. Figures are drawn by
Matplotlib's object interface, so no global state is touched.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from overfly.cloud import Cloud
from overfly.geometry import Array, rotation_from_gimbal
from overfly.mapping.block_marks import Marks, draw_links, draw_residuals, scale_of
from overfly.mapping.oblique import PAPER, oblique_view
from overfly.mapping.raster import Grid, Surface, grid_over, surface

__all__ = [
    "block_map", "height_map", "hillshade", "jpeg", "nice_length", "oblique_view", "origin_map", "overview", "png",
    "top_view", "views_map",
]  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]
INK, GREY, GOOD, WARN, BAD = "#1f2933", "#7b8794", "#0f7b6c", "#d9822b", "#c23030"


def png(image: Image) -> bytes:
    """The bytes of a PNG file."""
    from PIL import Image as Pillow

    buffer = io.BytesIO()
    Pillow.fromarray(image).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def jpeg(image: Image, quality: int = 88) -> bytes:
    """The bytes of a JPEG file: a tenth of a PNG's size for photographs."""
    from PIL import Image as Pillow

    buffer = io.BytesIO()
    Pillow.fromarray(image).save(buffer, "JPEG", quality=quality)
    return buffer.getvalue()


def overview(cloud: Cloud, *, pixels: int = 900, min_cell: float = 0.0) -> Surface:
    """The surface seen from above on a grid of at most about ``pixels`` cells per side, small gaps closed.

    Sparse clouds get larger cells, so that the ground does not fall apart into dots.
    """
    spread = grid_over(cloud.points, 1.0, trim=0.002)
    x_min, x_max, y_min, y_max = spread.extent
    side = max(x_max - x_min, y_max - y_min)
    coarse = grid_over(cloud.points, side / 60, trim=0.002)
    covered = coarse.hit(cloud.points) * coarse.cell**2
    sparse = float(np.sqrt(1.5 * covered / len(cloud)))
    cell = max(side / pixels, min_cell, min(sparse, side / 40))
    return surface(cloud, grid_over(cloud.points, cell, trim=0.002), fill=2)


def top_view(seen: Surface) -> Image:
    """The colours from above on white; clouds without colour are shaded grey."""
    if seen.colors is None:
        shade = (hillshade(seen) * 255).astype(np.uint8)
        return np.repeat(shade[..., None], 3, axis=-1)
    return np.where(seen.filled[..., None], seen.colors, PAPER).astype(np.uint8)


def hillshade(seen: Surface, *, azimuth_deg: float = 315.0, elevation_deg: float = 45.0) -> Array:
    """Lambert shading in 0..1 by a light in the north-west; 1 where empty [rows, columns]."""
    from scipy.ndimage import gaussian_filter

    known = seen.filled.astype(float)
    weight = np.maximum(gaussian_filter(known, 0.8), 1e-6)
    smooth = gaussian_filter(np.nan_to_num(seen.heights), 0.8) / weight
    down, east = np.gradient(smooth, seen.grid.cell)
    normal = np.stack([-east, down, np.ones_like(east)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    light = -rotation_from_gimbal(azimuth_deg + 180, -elevation_deg)[:, 2]
    return np.where(seen.filled, np.clip(normal @ light, 0, 1), 1.0)


def height_map(seen: Surface, *, offset: float = 0.0, unit: str = "m", width_in: float = 5.6) -> Image:
    """Heights (plus ``offset``) in colour over a hillshade, with colour bar, scale bar and north arrow."""
    from matplotlib import colormaps
    from matplotlib.colors import Normalize
    from matplotlib.ticker import ScalarFormatter

    figure, axes = _map_figure(seen.grid, width_in)
    values = seen.heights[seen.filled]
    low, high = (float(v) for v in np.percentile(values, [0.5, 99.5])) if values.size else (0.0, 1.0)
    high = max(high, low + 4 * seen.grid.cell)  # flat ground is one colour, not a rainbow of noise
    norm, colours = Normalize(low, high), colormaps["turbo"]
    shaded = colours(norm(np.nan_to_num(seen.heights, nan=low)))[..., :3]
    shaded = shaded * (0.35 + 0.65 * np.minimum(hillshade(seen) / 0.72, 1.2))[..., None]
    shaded = np.where(seen.filled[..., None], np.clip(shaded, 0, 1), 1.0)
    axes.imshow(shaded, extent=seen.grid.extent, interpolation="nearest")
    norm = Normalize(low + offset, high + offset)
    plain = ScalarFormatter(useOffset=False)
    bar = figure.colorbar(_mappable(norm, colours), ax=axes, shrink=0.8, pad=0.02, aspect=30, format=plain)
    bar.set_label(f"height ({unit})", color=INK)
    bar.outline.set_visible(False)
    _furnish(axes, seen.grid, unit)
    return _drawn(figure)


def views_map(
    grid: Grid,
    views: ArrayLike,
    *,
    unit: str = "m",
    width_in: float = 5.6,
    outlines: Sequence[Array] = (),
    track: Array | None = None,
    wanted: Sequence[Array] = (),
) -> Image:
    """How many frames see each cell [rows, columns]; NaN where nothing was mapped.

    Footprints may be drawn by their ``outlines``, the cameras by their ``track`` [n, 2], and lines that should be flown
    too as ``wanted`` [m, 2].
    """
    from matplotlib.colors import BoundaryNorm, ListedColormap

    figure, axes = _map_figure(grid, width_in)
    colours = ListedColormap(["#c23030", "#f0a13a", "#f6e08a", "#a5d6a7", "#4caf72", "#0f7b6c"])
    norm = BoundaryNorm([0.5, 1.5, 2.5, 3.5, 5.5, 9.5, 1000], colours.N)
    shown = np.ma.masked_invalid(np.where(np.asarray(views, float) < 0.5, np.nan, views))
    axes.imshow(shown, extent=grid.extent, interpolation="nearest", cmap=colours, norm=norm)
    for outline in outlines:
        axes.fill(outline[:, 0], outline[:, 1], fill=False, edgecolor=INK, linewidth=0.4, alpha=0.35)
    if track is not None:
        axes.plot(track[:, 0], track[:, 1], "-o", color=INK, linewidth=0.6, markersize=1.8, alpha=0.7)
    for line in wanted:
        axes.plot(line[:, 0], line[:, 1], "--", color="#7b1fa2", linewidth=2)
    bar = figure.colorbar(
        _mappable(norm, colours), ax=axes, shrink=0.8, pad=0.02, aspect=30, ticks=[1, 2, 3, 4.5, 7.5, 500]
    )
    bar.ax.set_yticklabels(["1", "2", "3", "4–5", "6–9", "10 +"])
    bar.set_label("images that see the place", color=INK)
    bar.outline.set_visible(False)
    _furnish(axes, grid, unit)
    return _drawn(figure)


def block_map(
    seen: Surface,
    positions: ArrayLike,
    outlines: Sequence[Array],
    *,
    missing: Sequence[tuple[str, ArrayLike]] = (),
    names: Sequence[str] = (),
    marks: Marks | None = None,
    unit: str = "m",
    width_in: float = 5.6,
) -> Image:
    """Where the images were taken and what they cover, over the faded map.

    Args:
        seen: the map from above.
        positions: [n, >=2] of the registered cameras, in the order of the flight.
        outlines: their footprints [4, 2].
        missing: name and x, y of frames that were not registered but whose GPS is known.
        names: labels of the first and last frame.
        marks: links, residuals and ground control, drawn with their factor.
    """
    points = np.asarray(positions, float).reshape(-1, np.shape(positions)[-1] if np.size(positions) else 3)[:, :2]
    corners = [o for o in outlines if np.isfinite(o).all()]
    lost = np.array([np.asarray(p, float)[:2] for _, p in missing]).reshape(-1, 2)
    x_min, x_max, y_min, y_max = seen.grid.extent
    everything = np.concatenate([points, lost, *corners, [[x_min, y_min], [x_max, y_max]]])
    # An oblique footprint may reach far away: keep the map readable.
    margin = 0.25 * max(x_max - x_min, y_max - y_min)
    inside = np.concatenate([points, lost, [[x_min, y_min], [x_max, y_max]]])
    low = np.maximum(everything.min(0), inside.min(0) - margin)
    high = np.minimum(everything.max(0), inside.max(0) + margin)
    cell = max(high - low) / 600
    frame = Grid(low[0], high[1], cell, int((high[1] - low[1]) / cell) + 1, int((high[0] - low[0]) / cell) + 1)
    figure, axes = _map_figure(frame, width_in)
    faded = 255 - (255 - top_view(seen).astype(float)) * 0.45
    axes.imshow(faded.astype(np.uint8), extent=seen.grid.extent, interpolation="nearest")
    many = np.clip(12 / max(len(corners), 1), 0.15, 1)  # hundreds of footprints must not hide the map
    for corner in corners:
        axes.fill(corner[:, 0], corner[:, 1], facecolor=GOOD, edgecolor=GOOD, alpha=0.06 * many)
        axes.fill(corner[:, 0], corner[:, 1], fill=False, edgecolor=GOOD, linewidth=0.5, alpha=0.7 * many)
    if marks is None or not marks.links:
        axes.plot(points[:, 0], points[:, 1], "-", color=INK, linewidth=0.7, alpha=0.6)
    else:
        draw_links(axes, points, marks.links)
    axes.plot(points[:, 0], points[:, 1], "o", color=GOOD, markersize=4, label=f"registered ({len(points)})")
    if marks is not None:
        factor = scale_of(marks, float(np.ptp(points, axis=0).max()))
        draw_residuals(axes, points, marks, factor)
        axes.plot([], [], " ", label=f"residuals and sigma {factor:g} times")
    if len(lost):
        axes.plot(lost[:, 0], lost[:, 1], "x", color=BAD, markersize=7, mew=2, label=f"not registered ({len(lost)})")
        for (name, _), (x, y) in list(zip(missing, lost, strict=True))[:12]:
            axes.annotate(name, (x, y), textcoords="offset points", xytext=(5, 4), fontsize=7, color=BAD)
    for index, label in ((0, "start"), (-1, "end")):
        if len(points) > 1:
            text = f"{label}: {names[index]}" if names else label
            axes.annotate(
                text, points[index], textcoords="offset points", xytext=(6, 6), fontsize=7.5, color=INK,
                bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
            )  # fmt: skip
    axes.legend(loc="lower right", frameon=True, framealpha=0.85, edgecolor="none", fontsize=8)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    _furnish(axes, frame, unit)
    return _drawn(figure)


def origin_map(seen: Surface, *, unit: str = "m", width_in: float = 5.6) -> Image | None:
    """Measured (green) and predicted (orange) ground; None where the cloud does not tell."""
    if seen.predicted is None:
        return None
    figure, axes = _map_figure(seen.grid, width_in)
    shade = (0.55 + 0.45 * np.minimum(hillshade(seen) / 0.72, 1))[..., None]
    share = np.nan_to_num(seen.predicted)[..., None]
    mixed = (1 - share) * np.array([0.36, 0.69, 0.60]) + share * np.array([0.95, 0.62, 0.27])
    known = np.isfinite(seen.predicted)[..., None]
    axes.imshow(np.where(known, mixed * shade, 1.0), extent=seen.grid.extent, interpolation="nearest")
    for label, colour in (("measured in two or more images", "#5cb099"), ("predicted", "#f29e45")):
        axes.plot([], [], "s", color=colour, label=label)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)  # corners are what is predicted
    _furnish(axes, seen.grid, unit)
    return _drawn(figure)


def _map_figure(grid: Grid, width_in: float) -> tuple[Figure, Axes]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    x_min, x_max, y_min, y_max = grid.extent
    aspect = float(np.clip((y_max - y_min) / max(x_max - x_min, 1e-9), 0.35, 1.6))
    figure = Figure(figsize=(width_in, width_in * 0.82 * aspect + 0.2), dpi=165, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    return figure, axes


def _mappable(norm: Any, colours: Any) -> Any:
    from matplotlib.cm import ScalarMappable

    return ScalarMappable(norm, colours)


def _furnish(axes: Axes, grid: Grid, unit: str) -> None:
    """Scale bar and north arrow in place of axes; a frame without metres knows no north either, so its y is shown."""
    up = "N" if unit == "m" else "y"
    axes.set_axis_off()
    x_min, x_max, y_min, y_max = grid.extent
    width, height = x_max - x_min, y_max - y_min
    length = nice_length(width / 4)
    x, y = x_min + 0.03 * width, y_min + 0.035 * height
    halo = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "boxstyle": "round,pad=0.25"}
    axes.plot([x, x + length], [y, y], color="white", linewidth=6, solid_capstyle="butt", alpha=0.75)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2.5, solid_capstyle="butt")
    axes.annotate(
        f"{length:g} {unit}", (x + length / 2, y), textcoords="offset points", xytext=(0, 7), ha="center",
        fontsize=8, color=INK, bbox=halo,
    )  # fmt: skip
    axes.annotate(
        up, xy=(0.965, 0.985), xytext=(0.965, 0.875), xycoords="axes fraction", ha="center", fontsize=9, color=INK,
        bbox=halo, arrowprops={"arrowstyle": "-|>", "color": INK, "linewidth": 1.6},
    )  # fmt: skip
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)


def nice_length(longest: float) -> float:
    """The largest of 1, 2, 5 x 10^k that is not longer than ``longest``."""
    power = 10.0 ** np.floor(np.log10(longest))
    return float(max(step * power for step in (1, 2, 5) if step * power <= longest))


def _drawn(figure: Figure) -> Image:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = figure.canvas
    assert isinstance(canvas, FigureCanvasAgg)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
