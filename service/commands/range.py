"""`panelwright range` and `panelwright batch range`: find the surfaces in recorded range images."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from hal.errors import CellError, InvalidRequest
from service.commands.common import console
from service.commands.shutdown import INTERRUPTED, one_interrupt
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hal.arrays import Array
    from perception.range import BatchResult, KeptResults, Match, RangeScene, Reading, Surface

batch = typer.Typer(help="Process folders of recordings with many workers (dask).", no_args_is_help=True)
SHOWN_ERRORS = 5
SHOWN_SURFACES = 25

Scale = Annotated[float | None, typer.Option(help="Metres per unit, in place of the file's own unit (0.001 for mm).")]
Near = Annotated[float | None, typer.Option(help="Distance in metres at code 0 of 8-bit codes; needs --far.")]
Far = Annotated[float | None, typer.Option(help="Distance in metres at code 255 of 8-bit codes; needs --near.")]
Focal = Annotated[str | None, typer.Option(help="Focal length of a pinhole sensor: F or FX,FY in pixels.")]
Centre = Annotated[
    str | None, typer.Option(help="Centre of a pinhole sensor: CX,CY in pixels; the image's middle by default.")
]
Pitch = Annotated[float | None, typer.Option(help="Distance between pixels of an orthographic sensor, m.")]


def range_image(
    file: Annotated[Path, typer.Argument(help="Recording: npz, npy, PNG or TIFF.")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the results; created if missing.")] = Path(),
    models: Annotated[str | None, typer.Option(help="Also find components: a file of models, or `shipped`.")] = None,
    record: Annotated[
        Path | None, typer.Option(help="Calibration record whose depth_bend is taken out (`calibrate depth`).")
    ] = None,
    scale: Scale = None,
    near: Near = None,
    far: Far = None,
    focal: Focal = None,
    centre: Centre = None,
    pitch: Pitch = None,
) -> None:
    """Analyse one range image and write NAME.surfaces.json, .png (coloured) and .ply (coloured points)."""
    from perception.range import (
        MARK,
        analyse,
        assumptions,
        load_models,
        load_recording,
        match_models,
        scene_json,
        write_ply,
        write_png,
    )

    reading = reading_of(scale, near, far, focal, centre, pitch)
    library = () if models is None else load_models() if models == "shipped" else load_models(Path(models))
    compile_first()
    depth, sensor = load_recording(file, reading=reading)
    if record is not None:
        depth = _without_bend(depth, record)
    scene = analyse(depth, sensor)
    matches = match_models(scene, depth, library) if library else ()
    assumed = assumptions(file, reading)
    _print_surfaces(scene)
    _print_matches(matches)
    for sentence in (*scene.warnings, *assumed):
        console.print(f"[yellow]note[/]   {escape(sentence)}")
    document = {"recording": file.name, "assumed": list(assumed), **scene_json(scene, matches)}
    written = [_in_folder(out) / f"{file.stem}{MARK}{suffix}" for suffix in (".json", ".png", ".ply")]
    written[0].write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    write_png(written[1], scene)
    write_ply(written[2], scene, depth)
    console.print("wrote " + ", ".join(str(path) for path in written), markup=False)


@batch.command("range")
def batch_range_images(
    folder: Annotated[Path, typer.Argument(help="Folder of recordings: npz, npy, PNG or TIFF.")],
    *,
    scheduler: Annotated[
        str, typer.Option(help='Scheduler: "local", or tcp://host:port of a dask scheduler.')
    ] = "local",
    workers: Annotated[int, typer.Option(min=1, max=256, help="Number of processes of the local scheduler.")] = 2,
    out: Annotated[Path, typer.Option(help="File for the results, one JSON object per line.")] = Path("surfaces.jsonl"),
    scale: Scale = None,
    near: Near = None,
    far: Far = None,
    focal: Focal = None,
    centre: Centre = None,
    pitch: Pitch = None,
    afresh: Annotated[
        bool, typer.Option("--afresh", help="Discard the results that an interrupted batch has left beside --out.")
    ] = False,
) -> None:
    """Analyse every recording of a folder; the exit code is 1 when one of them gave no result.

    After Ctrl-C the same command continues where it was interrupted.
    """
    from perception.range import KeptResults, batch_range, recordings_in

    reading = reading_of(scale, near, far, focal, centre, pitch)
    total = len(recordings_in(folder))
    _in_folder(out.parent)  # checked before hours of work
    kept = KeptResults(out, folder, reading, afresh=afresh)
    if kept.goes_on:
        console.print(f"continuing {kept.part}; --afresh would start again", markup=False)
    compile_first()
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    try:
        with one_interrupt(), Progress(*columns, console=console) as bar:
            task = bar.add_task("range images", total=total)
            results = batch_range(
                folder,
                scheduler=scheduler,
                workers=workers,
                reading=reading,
                progress=lambda done, _: bar.update(task, completed=done),
                kept=kept,
            )
    except KeyboardInterrupt:
        _print_kept("stopped: ", kept, total)
        raise typer.Exit(INTERRUPTED) from None
    except CellError:
        _print_kept("", kept, total)
        raise
    kept.finish(results)
    failed = [result for result in results if result.error is not None]
    _print_failed(failed)
    console.print(f"wrote {out}: {total - len(failed)} of {total} recordings analysed", markup=False)
    raise typer.Exit(1 if failed else 0)


def reading_of(
    scale: float | None,
    near: float | None,
    far: float | None,
    focal: str | None,
    centre: str | None,
    pitch: float | None,
) -> Reading:
    """Return how a recording is to be read, from the options of a command."""
    from perception.range import Reading

    return Reading(
        scale_m=scale,
        near_m=near,
        far_m=far,
        focal_px=None if focal is None else _pair(focal, "--focal"),
        centre_px=None if centre is None else _pair(centre, "--centre"),
        pitch_m=pitch,
    )


def _without_bend(depth_m: Array, path: Path) -> Array:
    """Return a depth image without the bend of a record.

    Raises:
        InvalidRequest: the record has none, or that of another resolution.
    """
    from hal.calibration import load_calibration

    bend = load_calibration(path).depth_bend
    if bend is None:
        raise InvalidRequest(f"{path} has no [depth_bend]", hint="measure it with `panelwright calibrate depth`")
    return bend.straightened(depth_m).astype(float)


def _pair(text: str, option: str) -> tuple[float, float]:
    """Return the two numbers of an option; a single number counts as both."""
    try:
        numbers = [float(part) for part in text.split(",")]
        first, second = numbers if len(numbers) > 1 else numbers * 2
    except ValueError:
        raise InvalidRequest(f"{option} {text!r} is not two numbers", hint=f"for example {option} 525,525") from None
    return first, second


def _in_folder(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidRequest(f"{folder} cannot be written: {error.strerror}", hint="choose another --out") from None
    return folder


def _print_surfaces(scene: RangeScene) -> None:
    table = Table("label", "type", "pixels", "what", "rms", box=None, pad_edge=False)
    for surface in scene.surfaces[:SHOWN_SURFACES]:
        row = (str(surface.label), str(surface.type), str(surface.pixels), _words(surface))
        table.add_row(*row, f"{1e3 * surface.rms_m:.2f} mm")
    console.print(table)
    if len(scene.surfaces) > SHOWN_SURFACES:
        console.print(f"and {len(scene.surfaces) - SHOWN_SURFACES} smaller ones")


def _print_matches(matches: Sequence[Match]) -> None:
    for match in matches:
        x, y, z = 1e3 * match.sensor_from_object.parent_from_child.translation
        surfaces = ", ".join(f"{name} {label}" for name, label in match.labels.items())
        console.print(f"{match.model} at ({x:.1f}, {y:.1f}, {z:.1f}) mm: {surfaces}", markup=False)


def _print_kept(head: str, kept: KeptResults, total: int) -> None:
    console.print(f"{head}{kept.done} of {total} recordings done, kept in {kept.part}", markup=False)
    console.print("  try    run the same command to continue, or add --afresh to start again", markup=False)


def _print_failed(failed: list[BatchResult]) -> None:
    for result in failed[:SHOWN_ERRORS]:
        console.print(f"[red]failed[/] {escape(result.name)}  {escape(result.error or '')}")
    if len(failed) > SHOWN_ERRORS:
        console.print(f"[red]failed[/] and {len(failed) - SHOWN_ERRORS} more; the results name them")


def _words(surface: Surface) -> str:
    """Return the dimensions that distinguish a surface from others, in millimetres and degrees."""
    from math import degrees

    from perception.range import Cone, Cylinder, Ellipsoid, Plane, Sphere

    p = surface.primitive
    match p:
        case Plane():
            x, y, z = p.normal
            return f"normal {x:.3f} {y:.3f} {z:.3f}, {1e3 * abs(float(p.normal @ p.point_m)):.1f} mm off"
        case Sphere() | Cylinder():
            return f"radius {1e3 * p.radius_m:.2f} mm" + (", from inside" if p.seen_from_inside else "")
        case Cone():
            return f"half angle {degrees(p.half_angle_rad):.2f} deg" + (", from inside" if p.seen_from_inside else "")
        case Ellipsoid():
            return "radii " + ", ".join(f"{1e3 * r:.1f}" for r in p.radii_m) + " mm"
