"""`panelwright read`: one instrument in a photograph, without a cell and without a service."""

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
    """Kinds that are read in a photograph."""

    GAUGE = "gauge"
    DIAL = "dial"
    DISPLAY = "display"


def read(
    photo: Annotated[Path, typer.Argument(help="PNG, JPEG or BMP, cropped to the instrument.")],
    *,
    kind: Annotated[
        InstrumentKind,
        typer.Option(help="gauge: part of a turn; dial: a full turn from straight up; display: seven segments."),
    ],
    scale: Annotated[str | None, typer.Option(help="Values at the ends of the scale: 0..10.")] = None,
    ends: Annotated[
        str | None,
        typer.Option(help="Pointer angles there, degrees clockwise from straight up: -135..135; else the ticks tell."),
    ] = None,
    unit: Annotated[str, typer.Option(help="Of the scale.")] = "",
    scene: Annotated[bool, typer.Option("--scene", help="The display is somewhere in the picture.")] = False,
    least_confidence: Annotated[float, typer.Option(min=0.0, max=1.0, help="Less sure readings are refused.")] = 0.5,
    json: Annotated[bool, typer.Option("--json", help="Print the whole answer as JSON.")] = False,
) -> None:
    """Read one gauge, dial or display in a photograph, with nothing taught but its kind and its scale.

    Ends with exit code 1 when the instrument cannot be told.
    """
    ends_deg = _span(ends, "--ends")
    found = read_pixels(
        read_image(photo),
        kind.value,
        scale=_span(scale, "--scale"),
        ends_rad=None if ends_deg is None else (math.radians(ends_deg[0]), math.radians(ends_deg[1])),
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
    return f"{found.value:.4g} {found.unit}".strip() + f"  (one sigma {found.uncertainty:.2g}, {sure})"


def _span(text: str | None, option: str) -> tuple[float, float] | None:
    """Two numbers with `..` between them."""
    if text is None:
        return None
    first, mark, last = text.partition(RANGE)
    try:
        if not mark:
            raise ValueError
        return float(first), float(last)
    except ValueError:
        raise InvalidRequest(f"{option} {text[:40]!r} is no range", hint=f"two numbers, as in {option}=0..10") from None
