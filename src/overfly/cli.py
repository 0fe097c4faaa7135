"""The `overfly` command: thin. It parses, calls and prints; heavy packages are imported when a command runs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from overfly import __version__
from overfly.errors import InputError
from overfly.mapping.needs import SIZE

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
    camera: Annotated[str, typer.Option(help="A camera: phantom4, p4p, mavic2pro, mavic3e, p1, ...")] = "p4p",
    width: Annotated[int | None, typer.Option(help="Image width, pixels. Default: 800.")] = None,
    height: Annotated[int | None, typer.Option(help="Image height, pixels. Default: by the sensor.")] = None,
    area: Annotated[
        float | None, typer.Option(help="Side of the square flown over, metres. Default: 5 x 5 frames.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="At most so many frames.")] = None,
    seed: Annotated[int, typer.Option(help="Of the landscape, the light and the noise.")] = 0,
    noise: Annotated[str, typer.Option(help="Of GPS and gimbal in the images: none, gps or rtk.")] = "none",
    processes: Annotated[int, typer.Option(help="That render side by side.")] = 1,
) -> None:
    """Photograph a landscape whose geometry is known: a flight folder with exact cameras and a reference cloud."""
    from overfly.flights import fly as fly_over

    plan, _ = fly_over(
        scene,
        out=out,
        flight_path=path,
        overlap=overlap,
        side_overlap=side_overlap,
        altitude=altitude,
        camera=camera,
        width=width,
        height=height,
        area_m=area,
        frames=frames,
        seed=seed,
        noise=noise,
        processes=processes,
    )
    print(plan.summary())


@app.command()
def plan(
    area: Annotated[
        str, typer.Option(help="WIDTHxHEIGHT in metres, LAT,LON,WIDTH,HEIGHT, or a .kml/.geojson polygon.")
    ],
    camera: Annotated[str, typer.Option(help="A camera: phantom4, p4p, mavic2pro, mavic3e, p1, ...")],
    gsd: Annotated[float | None, typer.Option(help="Centimetres per pixel on the ground.")] = None,
    altitude: Annotated[float | None, typer.Option(help="Or metres above ground, 20 to 500.")] = None,
    path: Annotated[str, typer.Option(help="grid, double_grid or circular.")] = "grid",
    overlap: Annotated[float, typer.Option(help="Along the lines, percent.")] = 80,
    side_overlap: Annotated[float, typer.Option(help="Between lines, percent.")] = 60,
    speed: Annotated[float | None, typer.Option(help="Metres a second. Default: a photo every 2 s, at most 8.")] = None,
    at: Annotated[str | None, typer.Option(help="LAT,LON of the area's middle; waypoint files need it.")] = None,
    kml: Annotated[Path | None, typer.Option(help="Write the flight here as KML.")] = None,
    litchi: Annotated[Path | None, typer.Option(help="Write the mission here as Litchi CSV.")] = None,
) -> None:
    """Before flying: path, height, photographs, time and expected accuracy for an area; waypoint files."""
    from overfly.preflight.report import plan_and_tell

    plan_and_tell(
        area,
        kml=kml,
        litchi=litchi,
        camera=camera,
        gsd_cm=gsd,
        altitude=altitude,
        path=path,
        overlap=overlap,
        side_overlap=side_overlap,
        speed=speed,
        at=at,
    )


@app.command()
def check(
    flight: Annotated[Path, typer.Argument(help="A flight folder, or any folder of drone photos.")],
    altitude: Annotated[
        float | None, typer.Option(help="Metres over ground, where the photos do not tell it or tell it wrongly.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures and findings here.")] = None,
    picture: Annotated[Path | None, typer.Option(help="Write the overlap map here, as PNG.")] = None,
    processes: Annotated[int, typer.Option(help="That look at images side by side.")] = 1,
) -> None:
    """Before mapping: overlap, gaps, expected accuracy, blur, GPS faults, time; each with its remedy."""
    from overfly.preflight.report import check_and_tell

    raise SystemExit(check_and_tell(flight, altitude=altitude, json=json, picture=picture, processes=processes))


@app.command("map")
def map_(
    flight: Annotated[Path, typer.Argument(help="A flight folder, or any folder of drone photos.")],
    out: Annotated[Path, typer.Option(help="Where the map goes.")],
    network: Annotated[
        str | None,
        typer.Option(
            help="For --dense sweep and the matchers encoder, both and auto: a run folder of train.py or the name of a "
            "shipped network. Default: the shipped one."
        ),
    ] = None,
    cameras: Annotated[str, typer.Option(help="auto (given ones if there are any), given, or estimate.")] = "auto",
    calibration: Annotated[
        str | None,
        typer.Option(
            metavar="<path>",
            help="Calibrated camera to be kept: folder of a map, transforms.json, COLMAP's cameras.txt, ODM's "
            "cameras.json. Default: the flight calibrates its camera.",
        ),
    ] = None,
    matcher: Annotated[
        str,
        typer.Option(help="Of key points: sift, encoder (of the network), both, or auto: sift, and both if in need."),
    ] = "auto",
    control: Annotated[
        str, typer.Option(help="Points of gcp_list.txt: split (a quarter only checks), all, or none.")
    ] = "split",
    dense: Annotated[str, typer.Option(help="sweep (network and stereo together) or stereo alone.")] = "sweep",
    size: Annotated[int, typer.Option(help="Longest side at which images are matched, pixels.")] = SIZE,
    max_memory: Annotated[
        float | None,
        typer.Option(help="Memory for dense cloud and products, GB. Default: half of what is free, at most 6."),
    ] = None,
    resume: Annotated[bool, typer.Option(help="Reuse finished steps of an interrupted map in --out.")] = True,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another flight's map in --out.")] = False,
    heights: Annotated[
        str | None,
        typer.Option(
            help="Of the products: ellipsoidal, egm96, egm2008, or the EPSG code of a vertical CRS. Default: as in "
            "gcp_list.txt, else ellipsoidal."
        ),
    ] = None,
    ply: Annotated[bool, typer.Option("--ply", help="Write cloud.ply too.")] = False,
    mesh: Annotated[
        bool, typer.Option("--mesh", help="Write mesh.glb too: the surface, textured from the photographs.")
    ] = False,
    mesh_faces: Annotated[int | None, typer.Option(help="Its triangles, about. Default: 200000.")] = None,
    seed: Annotated[int, typer.Option(help="Of every random choice.")] = 0,
) -> None:
    """Photographs in, map out: coloured cloud, height raster, orthophoto and report."""
    from overfly.mapping.map import map_flight

    def load() -> Any:
        from overfly.shipped import load_network

        return load_network(network)

    # Where it is sure to be needed, or was named, a wrong name is told at once.
    at_once = dense == "sweep" or matcher in ("encoder", "both") or network is not None
    map_flight(
        flight,
        out=out,
        network=load() if at_once else load,
        network_name=network or "shipped",
        cameras=cameras,
        calibration=calibration,
        matcher=matcher,
        control=control,
        dense=dense,
        size=size,
        max_memory_gb=max_memory,
        resume=resume,
        overwrite=overwrite,
        heights=heights,
        ply=ply,
        mesh=mesh,
        mesh_faces=mesh_faces,
        seed=seed,
    )


@app.command()
def refine(
    flight: Annotated[Path, typer.Argument(help="A flight folder, or any folder of drone photos.")],
    out: Annotated[Path, typer.Option(help="Where the refined mesh, pictures and figures go.")],
    mesh: Annotated[
        Path | None, typer.Option(help="A rough mesh in the frame of the flight's cameras. Default: made by stereo.")
    ] = None,
    generator: Annotated[str, typer.Option(help="vertices (each is free) or network (over them).")] = "vertices",
    width: Annotated[int, typer.Option(help="At which photographs are compared, pixels.")] = 1024,
    faces: Annotated[int, typer.Option(help="Of the refined mesh, about.")] = 200_000,
    hold_out: Annotated[int, typer.Option(help="One photograph out of so many is only measured on; 0: none.")] = 6,
    adversarial: Annotated[
        float | None, typer.Option("--lambda", help="Weight of the critic; 0: none. Default: as in conf/loss.")
    ] = None,
    cameras: Annotated[str, typer.Option(help="auto (given ones if there are any), given, or estimate.")] = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace another refinement in --out.")] = False,
) -> None:
    """Refine a rough mesh until its renderings look like the photographs (SS-GAN-3D)."""
    from overfly.refine import refine as run

    raise SystemExit(
        run(
            flight,
            out=out,
            mesh=mesh,
            generator=generator,
            width=width,
            faces=faces,
            hold_out=hold_out,
            adversarial=adversarial,
            cameras=cameras,
            overwrite=overwrite,
        )
    )


@app.command()
def evaluate(
    cloud: Annotated[Path, typer.Argument(help="The cloud to judge: .ply, .las or .laz.")],
    reference: Annotated[Path, typer.Argument(help="The true cloud.")],
    align: Annotated[str, typer.Option(help="none, shift, rigid or similarity.")] = "none",
    gsd: Annotated[float | None, typer.Option(help="Metres per pixel: adds F-scores at 1, 2, 3 and 5 GSD.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures here.")] = None,
) -> None:
    """Measure a cloud against a reference: Chamfer, EMD, F-score, accuracy, completeness; in metres."""
    from json import dumps

    from rich.console import Console

    from overfly.metrics.evaluate import evaluate as measure
    from overfly.metrics.evaluate import format_table

    result = measure(cloud, reference, align=align, gsd_m=gsd)
    if json is not None:
        json.parent.mkdir(parents=True, exist_ok=True)
        json.write_text(dumps(result, indent=2) + "\n")
    Console().print(format_table(result))


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="A run folder of train.py.")],
    out: Annotated[Path, typer.Option(help="The folder to write into.")],
    name: Annotated[str, typer.Option(help="By which the network will be asked for.")] = "base",
) -> None:
    """Write a run's best weights as safetensors, and beside them how they were trained and what they score."""
    from overfly.shipped import export as write

    for path in write(run, out, name):
        print(path)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def train(context: typer.Context) -> None:
    """Train, sweep, evaluate networks: as `python train.py`, from any folder (`overfly train stage=gan overlap=50`)."""
    from overfly.run import main as run

    raise SystemExit(run(context.args))


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
