"""`panelwright teach`: show one image and click at most three times, and the system knows a new kind of object."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hal.errors import InvalidRequest
from service.commands.common import console

if TYPE_CHECKING:
    from perception.vision.knowledge import Knowledge

NAME = re.compile(r"[a-z][a-z0-9_]{0,40}")


def teach(
    image: Annotated[Path, typer.Argument(help="Overview of one upright panel with its border in view.")],
    *,
    folder: Annotated[Path, typer.Option(help="Where taught kinds are kept; they come before the shipped ones.")],
    plate: Annotated[str, typer.Option(help="Width,height of the plate, m.")] = "0.60,0.40",
    kind: Annotated[str | None, typer.Option(help="Kind of the clicked object; a new name makes a new kind.")] = None,
    click: Annotated[
        list[str] | None, typer.Option(help="X,Y in pixels; the middle, or two opposite corners, then the middle.")
    ] = None,
    check: Annotated[bool, typer.Option("--check", help="Only show what is found with the taught kinds.")] = False,
) -> None:
    """Teach a kind of object by clicks, or show with --check what is found now."""
    from perception.vision import teach as lessons
    from perception.vision.image import decode
    from perception.vision.knowledge import write_kind

    plate_m = _pair(plate, "--plate")
    if min(plate_m) <= 0 or max(plate_m) > 10:
        raise InvalidRequest(f"no plate is {plate} m", hint="for example --plate 0.60,0.40")
    if check == (kind is not None):
        raise InvalidRequest("give either --kind or --check", hint="teach first, then check")
    try:
        pixels = decode(image.read_bytes())
    except OSError as error:
        raise InvalidRequest(f"{image} cannot be read: {error.strerror}", hint="check the path") from None
    knowledge = _known(folder)
    if kind is None:
        for found in lessons.check(pixels, knowledge, plate_m=plate_m):
            x, y = found.centre_px
            verdict = f"refused: {found.reason}" if found.reason else f"confidence {found.confidence:.2f}"
            console.print(f"{found.kind} at {x:.0f},{y:.0f} px  {verdict}", markup=False)
        return
    if not NAME.fullmatch(kind):
        raise InvalidRequest(f"{kind!r} is no name of a kind", hint="small letters, digits and underscores")
    clicks_px = [_pair(text, "--click") for text in click or ()]
    lesson = lessons.teach(
        pixels, knowledge, kind=kind, clicks_px=clicks_px, plate_m=plate_m, source="panelwright teach"
    )
    if not lesson.added:
        console.print(f"{kind} looks like that already: nothing was written", markup=False)
        return
    folder.mkdir(parents=True, exist_ok=True)
    console.print(f"wrote {write_kind(lesson.kind, folder)}", markup=False)


def _known(folder: Path) -> Knowledge:
    """The shipped kinds, each replaced by the folder's own of that name."""
    from perception.vision.knowledge import Knowledge, load_knowledge, shipped_knowledge

    shipped = shipped_knowledge()
    if not any(folder.glob("*.toml")):
        return shipped
    taught = load_knowledge(folder).kinds
    names = {kind.name for kind in taught}
    kinds = (*(kind for kind in shipped.kinds if kind.name not in names), *taught)
    return Knowledge(kinds=kinds, spread=shipped.spread)  # the unit of likeness stays what the shipped looks gave


def _pair(text: str, option: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise InvalidRequest(f"{option} {text!r} is not two numbers", hint=f"for example {option} 320,240") from None
    if not (abs(x) < 1e6 and abs(y) < 1e6):  # false for NaN too
        raise InvalidRequest(f"{option} {text!r} is out of range", hint="give finite numbers")
    return x, y
