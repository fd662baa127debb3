"""`panelwright read`: reads one instrument in a photograph, or in several, without a cell or a service."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape

from hal.errors import InvalidRequest
from service.commands.common import console
from service.commands.teach import read_image

if TYPE_CHECKING:
    from service.schema.results import PhotographMotion, PhotographReading

RANGE = ".."


class InstrumentKind(StrEnum):
    """Kinds of instruments that can be read in a photograph."""

    GAUGE = "gauge"
    DIAL = "dial"
    DISPLAY = "display"


class PointerColour(StrEnum):
    """Pointers that can be asked for where a gauge has two."""

    BLACK = "black"
    RED = "red"


Photos = Annotated[
    list[Path], typer.Argument(help="PNG, JPEG or BMP; several of one instrument, oldest first, tell how it moves.")
]
Kind = Annotated[
    InstrumentKind | None,
    typer.Option(
        help="gauge: scale over part of a turn; dial: full turn from straight up; display: digits of segments or dots, or drums; "
        "found anywhere in the picture if not given."
    ),
]
Picture = Annotated[Path | None, typer.Option(help="Write the last photograph with what was found to this PNG file.")]


def read(
    photos: Photos,
    *,
    kind: Kind = None,
    scale: Annotated[
        str | None,
        typer.Option(
            help="Values at the ends of the scale, clockwise, e.g. 0..10, or 10..0; a gauge's numerals tell them if not given."
        ),
    ] = None,
    ends: Annotated[
        str | None,
        typer.Option(
            help="Pointer angles at the ends, degrees clockwise from up, e.g. -135..135; read from the ticks if not given."
        ),
    ] = None,
    pointer: Annotated[
        PointerColour | None, typer.Option(help="Which pointer is read if a red one stands beside another one.")
    ] = None,
    unit: Annotated[
        str, typer.Option(help="Unit of the scale; the only legible one on a gauge's face if not given.")
    ] = "",
    scene: Annotated[bool, typer.Option("--scene", help="The picture is not cropped to the kind given.")] = False,
    least_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Readings with a lower confidence are refused.")
    ] = 0.5,
    picture: Picture = None,
    json: Annotated[bool, typer.Option("--json", help="Print the whole answer as JSON.")] = False,
) -> None:
    """Read one gauge, dial or display in a photograph; its kind, its place and its scale are found if they are not told.

    The exit code is 1 when the instrument cannot be read.
    """
    from service.knowledge.photographs import draw_reading, read_pictures
    from service.report.plots import png_of

    ends_deg = _span(ends, "--ends")
    pictures = [read_image(photo) for photo in photos]
    found = read_pictures(
        pictures,
        None if kind is None else kind.value,
        scale=_span(scale, "--scale"),
        ends_rad=None if ends_deg is None else (math.radians(ends_deg[0]), math.radians(ends_deg[1])),
        pointer=None if pointer is None else pointer.value,
        unit=unit,
        is_scene=scene,
        least_confidence=least_confidence,
    )
    if picture is not None:
        _write(picture, png_of(draw_reading(pictures[-1], found)))
    if json:
        typer.echo(found.model_dump_json())
    else:
        console.print(escape(_said(found)))
    if not found.answered:
        raise typer.Exit(1)


def _write(file: Path, data: bytes) -> None:
    try:
        file.write_bytes(data)
    except OSError as error:
        raise InvalidRequest(f"{file} cannot be written: {error.strerror}", hint="choose another --picture") from None


def _said(found: PhotographReading) -> str:
    if not found.answered:
        return f"cannot tell: {found.reason}"
    sure = f"confidence {found.confidence:.2f}"
    if found.text is not None:
        said = f"{found.text} {found.unit}".strip() + f"  ({sure})"
    else:
        by = "" if found.scale is None else f", on a scale from {found.scale.minimum:g} to {found.scale.maximum:g}"
        said = f"{found.value:.4g} {found.unit}".strip() + f"  (one sigma {found.uncertainty:.2g}, {sure}{by})"
    return said if found.motion is None else f"{said}\n{_moving(found.motion)}"


def _moving(motion: PhotographMotion) -> str:
    read = sum(value is not None for value in motion.values)
    return (
        f"mean of {read} of {len(motion.values)} pictures; "
        f"amplitude {motion.amplitude:.2g}, trend {motion.trend:+.2g} from one to the next"
    )


def _span(text: str | None, option: str) -> tuple[float, float] | None:
    """Return the two numbers of a text such as `0..10`."""
    if text is None:
        return None
    first, mark, last = text.partition(RANGE)
    try:
        if not mark:
            raise ValueError
        return float(first), float(last)
    except ValueError:
        raise InvalidRequest(f"{option} {text[:40]!r} is no range", hint=f"two numbers, as in {option}=0..10") from None
