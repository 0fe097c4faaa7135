"""Do roofs and walls of single houses stand out? Surface models of two programs as hillshades of the same ground.

    overfly map DATA/tampa_sheffield_cross --out tampa
    ppg new t.ppg; ppg add-photos t.ppg DATA/tampa_sheffield_cross/images; ppg align t.ppg
    ppg dense t.ppg; ppg dem t.ppg
    python benchmarks/houses.py tampa/dsm.tif t.ppg.files/chunk_0/dem.tif --out docs/houses.jpg

Both rasters are laid on the cells of the first one (the second bilinearly), and not aligned. ``--window`` takes
a part of it, left, top, width and height as shares.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import rasterio
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rasterio.warp import Resampling, reproject

STEEPER = 1.5
"""Heights are drawn so many times as steep."""


def surfaces(ours: Path, theirs: Path) -> tuple[NDArray, NDArray, float]:
    """Both surfaces [rows, columns] on the cells of the first, NaN where unknown, and the size of a cell, metres."""
    with rasterio.open(ours) as file:
        own = file.read(1, masked=True).filled(np.nan).astype(float)
        place, crs, cell = file.transform, file.crs, float(file.res[0])
    with rasterio.open(theirs) as file:
        other = np.full(own.shape, np.nan)
        reproject(file.read(1, masked=True).filled(np.nan).astype(float), other, src_transform=file.transform,
                  src_crs=file.crs, dst_transform=place, dst_crs=crs, src_nodata=np.nan, dst_nodata=np.nan,
                  resampling=Resampling.bilinear)  # fmt: skip
    return own, other, cell


def shaded(heights: NDArray, cell: float) -> NDArray:
    """Hillshade, light from the upper left; NaN where nothing is known."""
    known = np.isfinite(heights)
    filled = np.where(known, heights, np.nanmedian(heights))
    return np.where(known, LightSource(315, 45).hillshade(filled, vert_exag=STEEPER, dx=cell, dy=cell), np.nan)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("ours", type=Path)
    parser.add_argument("theirs", type=Path)
    parser.add_argument("--names", nargs=2, default=["Overfly", "pyarchinit-photogrammetry 1.6.0"])
    parser.add_argument("--window", nargs=4, type=float, default=[0.55, 0.22, 0.4, 0.5])
    parser.add_argument("--out", type=Path, default=Path("docs/houses.jpg"))
    options = parser.parse_args()
    own, other, cell = surfaces(options.ours, options.theirs)
    left, top, width, height = options.window
    rows, columns = own.shape
    part = (
        slice(int(top * rows), int((top + height) * rows)),
        slice(int(left * columns), int((left + width) * columns)),
    )
    figure = Figure(figsize=(12, 4.2), layout="constrained")
    panels = figure.subplots(1, 4, width_ratios=[1, 1, 0.8, 0.8])
    shown = [(own, slice(None)), (other, slice(None)), (own, part), (other, part)]
    for axes, name, (heights, window) in zip(panels, [*options.names, *options.names], shown, strict=True):
        axes.imshow(shaded(heights, cell)[window], cmap="gray", vmin=0, vmax=1)
        axes.set_title(name, fontsize=9)
        axes.set_axis_off()
    figure.savefig(options.out, dpi=110)


if __name__ == "__main__":
    main()
