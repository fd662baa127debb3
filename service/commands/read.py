"""`panelwright read`: reads one instrument in a photograph, without a cell or a service."""

from __future__ import annotations

import math
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from hal.errors import InvalidRequest
from service.commands.common import console
from service.commands.teach import read_image
from service.knowledge.photographs import read_pixels
from service.schema.results import PhotographReading

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


def read(
    photo: Annotated[Path, typer.Argument(help="PNG, JPEG or BMP, cropped to the instrument.")],
    *,
    kind: Annotated[
        InstrumentKind,
        typer.Option(
            help="gauge: scale over part of a turn; dial: full turn from straight up; display: seven segments."
        ),
    ],
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
    unit: Annotated[str, typer.Option(help="Unit of the scale.")] = "",
    scene: Annotated[bool, typer.Option("--scene", help="The picture is not cropped to the display.")] = False,
    least_confidence: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Readings with a lower confidence are refused.")
    ] = 0.5,
    json: Annotated[bool, typer.Option("--json", help="Print the whole answer as JSON.")] = False,
) -> None:
    """Read one gauge, dial or display in a photograph, of which only the kind is known, and perhaps the scale.

    The exit code is 1 when the instrument cannot be read.
    """
    ends_deg = _span(ends, "--ends")
    found = read_pixels(
        read_image(photo),
        kind.value,
        scale=_span(scale, "--scale"),
        ends_rad=None if ends_deg is None else (math.radians(ends_deg[0]), math.radians(ends_deg[1])),
        pointer=None if pointer is None else pointer.value,
        unit=unit,
        is_scene=scene,
        least_confidence=least_confidence,
    )
    if json:
        typer.echo(found.model_dump_json())
    else:
        console.print(escape(_said(found)))
    if not found.answered:
        raise typer.Exit(1)


def _said(found: PhotographReading) -> str:
    if not found.answered:
        return f"cannot tell: {found.reason}"
    sure = f"confidence {found.confidence:.2f}"
    if found.text is not None:
        return f"{found.text} {found.unit}".strip() + f"  ({sure})"
    by = "" if found.scale is None else f", on a scale from {found.scale.minimum:g} to {found.scale.maximum:g}"
    return f"{found.value:.4g} {found.unit}".strip() + f"  (one sigma {found.uncertainty:.2g}, {sure}{by})"


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
