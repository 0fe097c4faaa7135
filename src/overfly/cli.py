"""The `overfly` command: thin. It parses, calls and prints; heavy packages are imported when a command runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from overfly import __version__
from overfly.errors import InputError

app = typer.Typer(
    name="overfly",
    help="Aerial images of one drone flight into a measured 3D map.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


def _version(show: bool) -> None:
    if show:
        print(f"overfly {__version__}")
        raise typer.Exit


@app.callback()
def _overfly(
    version: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """Aerial images of one drone flight into a measured 3D map."""


@app.command()
def fly(
    scene: Annotated[str, typer.Argument(help="A style (blocks, suburb, ...) or a .ply/.obj/.glb/.laz/.tif file.")],
    out: Annotated[Path, typer.Option(help="The flight folder to write.")],
    path: Annotated[str, typer.Option(help="circular, grid, double_grid or random.")] = "grid",
    overlap: Annotated[float, typer.Option(help="Forward overlap, percent, 0 to 95.")] = 60,
    side_overlap: Annotated[float | None, typer.Option(help="Between lines, percent. Default: as --overlap.")] = None,
    altitude: Annotated[float, typer.Option(help="Metres above ground, 20 to 500.")] = 150,
    camera: Annotated[str, typer.Option(help="A camera preset.")] = "mavic3e",
    width: Annotated[int, typer.Option(help="Image width, pixels.")] = 800,
    area: Annotated[float | None, typer.Option(help="Side of the square that is flown over, metres.")] = None,
    seed: Annotated[int, typer.Option(help="Landscape, light and noise.")] = 0,
    gps_sigma: Annotated[float, typer.Option(help="GPS error, metres horizontally; 3 x that vertically.")] = 0.0,
) -> None:
    """Photograph a landscape whose geometry is known: a flight folder with exact cameras and a reference cloud."""
    from overfly.flights import fly as fly_over

    _done(
        fly_over(
            scene,
            out=out,
            flight_path=path,
            overlap=overlap,
            side_overlap=side_overlap,
            altitude=altitude,
            camera=camera,
            width=width,
            area_m=area,
            seed=seed,
            gps_sigma_m=gps_sigma,
        )
    )


@app.command("map")
def map_(
    flight: Annotated[Path, typer.Argument(help="A flight folder, or any folder of drone photos.")],
    out: Annotated[Path, typer.Option(help="Where the map goes.")],
    network: Annotated[str | None, typer.Option(help="A run folder with trained weights.")] = None,
    cameras: Annotated[str, typer.Option(help="auto: given ones if there are any; given; estimate.")] = "auto",
    dense: Annotated[str | None, typer.Option(help="sweep: the network; stereo: classical. Default: by --network.")] = None,
    max_memory: Annotated[float, typer.Option(help="Memory to use at most, GB.")] = 6.0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted map in --out.")] = False,
    ply: Annotated[bool, typer.Option("--ply", help="Write cloud.ply too.")] = False,
) -> None:
    """Photographs in, map out: coloured cloud, height raster, orthophoto and report."""
    from overfly.mapping.map import map_flight

    _done(
        map_flight(
            flight,
            out=out,
            network=network,
            cameras=cameras,
            dense=dense,
            max_memory_gb=max_memory,
            resume=resume,
            ply=ply,
        )
    )


@app.command()
def evaluate(
    cloud: Annotated[Path, typer.Argument(help="The cloud to judge: .ply, .las or .laz.")],
    reference: Annotated[Path, typer.Argument(help="The true cloud.")],
    align: Annotated[str, typer.Option(help="none, shift, rigid or similarity.")] = "none",
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Measure a cloud against a reference: Chamfer, EMD, F-score, accuracy, completeness; in metres."""
    from overfly.metrics.evaluate import evaluate as measure
    from overfly.metrics.evaluate import format_table

    result = measure(cloud, reference, align=align)
    if json is not None:
        from overfly.metrics.evaluate import write_json

        write_json(result, json)
    print(format_table(result))


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def train(context: typer.Context) -> None:
    """Train, sweep, compare: the same as `python train.py`, from any folder (`overfly train stage=gan overlap=50`)."""
    from overfly.run import main as run

    raise SystemExit(run(context.args))


def _done(result: Any) -> None:
    if isinstance(result, str):
        print(result)


def main() -> None:
    """The entry point: what the user can mend is one sentence and exit code 2."""
    try:
        app()
    except InputError as error:
        print(f"Error: {error}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Stopped. What is finished is kept and reused when you give the same command again.", file=sys.stderr)
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
