"""`panelwright teach`: teaches a kind by at most three clicks in one image, or a kind or panel by a dialogue."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hal.errors import InvalidRequest
from service.commands.common import console
from service.commands.warm import compile_first

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hal.panel import Question
    from perception.vision.teaching import Overview
    from service.knowledge.store import KnowledgeStore

MOST_PLATE_M = 10.0


class Terminal:
    """Asks a person, or a script on standard input."""

    def ask(self, question: Question) -> str:
        """Print a question on standard output and return one line of standard input."""
        from service.knowledge.dialogue import NobodyAnswers

        choices = f" [{'/'.join(question.choices)}]" if question.choices else ""
        default = f" ({question.default})" if question.default else ""
        console.print(f"{question.text}{choices}{default} ", end="", markup=False)
        line = sys.stdin.readline()
        if not line:
            console.print()
            raise NobodyAnswers("the answers ended before the questions", hint="start again; nothing more was written")
        if not sys.stdin.isatty():
            console.print(line.rstrip("\n"), markup=False)
        return line.strip()

    def say(self, text: str) -> None:
        """Print a line on standard output."""
        console.print(text, markup=False)


def teach(
    image: Annotated[
        Path,
        typer.Argument(help="Overview of one upright panel with its whole border in view, or with its corners told."),
    ],
    *,
    folder: Annotated[
        Path, typer.Option(help="Folder for taught kinds and panels, which take precedence over the shipped ones.")
    ] = Path("runs/knowledge"),
    plate: Annotated[str, typer.Option(help="WIDTH,HEIGHT of the plate, m.")] = "0.60,0.40",
    corner: Annotated[
        list[str] | None,
        typer.Option(
            help="X,Y in pixels of a corner of the plate, four times, in any order; without them its border is looked for."
        ),
    ] = None,
    kind: Annotated[str | None, typer.Option(help="Kind of the clicked object; a new name makes a new kind.")] = None,
    click: Annotated[
        list[str] | None,
        typer.Option(help="X,Y in pixels: the middle, or two opposite corners, or two corners and then the middle."),
    ] = None,
    from_panel: Annotated[
        Path | None,
        typer.Option(help="Panel file of the panel in the image, from which its looks are learned without clicks."),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only show what is recognised with the present knowledge.")
    ] = False,
    dialogue: Annotated[
        bool, typer.Option("--dialogue", help="Ask questions even if standard input is not a terminal.")
    ] = False,
) -> None:
    """Teach by clicks (--kind), by a panel file (--from-panel), or by a dialogue (without these options).

    With --check nothing is taught, and the command shows what is recognised now.
    """
    from service.knowledge.store import KnowledgeStore

    plate_m = _size(plate)
    pixels = read_image(image)
    _check_way(check, kind is not None, dialogue, from_panel is not None)
    compile_first()
    store = KnowledgeStore(folder)
    corners_px = _corners(corner)
    if from_panel is not None:
        _by_panel(store, pixels, from_panel, corners_px)
        return
    from perception.vision.teaching import overview_of

    overview = overview_of(pixels, plate_m=plate_m, corners_px=corners_px)
    if kind is not None:
        _by_clicks(store, overview, kind=kind, clicks=click or [])
        return
    from service.knowledge.dialogue import Dialogue

    talk = Dialogue(talk=Terminal(), store=store, pixels=pixels, overview=overview)
    if check:
        talk.show_found()
    else:
        talk.run()


def _check_way(*ways: bool) -> None:
    """Check that one way of teaching is given, or that a person can be asked."""
    if sum(ways) > 1:
        raise InvalidRequest("give one of --kind, --from-panel, --check and --dialogue", hint="teach first, then check")
    if not (any(ways) or sys.stdin.isatty()):
        raise InvalidRequest(
            "there is no terminal for the dialogue",
            hint="give --kind, --from-panel, --check, or --dialogue with answers on stdin",
        )


def _size(plate: str) -> tuple[float, float]:
    """Return the size of the plate, m."""
    plate_m = _pair(plate, "--plate")
    if min(plate_m) <= 0 or max(plate_m) > MOST_PLATE_M:
        raise InvalidRequest(f"no plate is {plate} m", hint="for example --plate 0.60,0.40")
    return plate_m


def _corners(corners: list[str] | None) -> tuple[tuple[float, float], ...] | None:
    """Return the corners of the plate, px; None if none is given."""
    if not corners:
        return None
    if len(corners) != 4:
        raise InvalidRequest(
            f"a plate has four corners, not {len(corners)}", hint="give --corner X,Y four times, or leave it out"
        )
    return tuple(_pair(text, "--corner") for text in corners)


def _by_clicks(store: KnowledgeStore, overview: Overview, *, kind: str, clicks: list[str]) -> None:
    from service.knowledge.teach import teach_kind

    taught = teach_kind(store, overview, kind=kind, clicks_px=tuple(_pair(text, "--click") for text in clicks))
    if not taught.added:
        console.print(f"this look of {kind} is known already; nothing was written", markup=False)
        return
    console.print(f"wrote {taught.path}", markup=False)


def _by_panel(
    store: KnowledgeStore,
    pixels: NDArray[np.uint8],
    panel_file: Path,
    corners_px: tuple[tuple[float, float], ...] | None,
) -> None:
    from hal.panel import load_panel
    from perception.vision import as_gray, check_upright, one_plate
    from service.commands.learn import tell
    from service.knowledge.teach import learn_panel

    panel, gray = load_panel(panel_file), as_gray(pixels)
    view = one_plate(gray, (panel.width_m, panel.height_m), corners_px=corners_px).view
    check_upright(gray, view, panel)
    learned = learn_panel(store, pixels, view, panel)
    tell(learned.result())


def read_image(image: Path) -> NDArray[np.uint8]:
    """Read the pixels of an image file.

    Raises:
        InvalidRequest: it cannot be read, or is no usable image.
    """
    from perception.vision import decode

    try:
        data = image.read_bytes()
    except OSError as error:
        raise InvalidRequest(f"{image} cannot be read: {error.strerror}", hint="check the path") from None
    try:
        return decode(data)
    except InvalidRequest as error:
        raise InvalidRequest(f"{image}: {error.what}", hint=error.hint) from None


def _pair(text: str, option: str) -> tuple[float, float]:
    example = "0.60,0.40" if option == "--plate" else "320,240"
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise InvalidRequest(f"{option} {text!r} is not two numbers", hint=f"for example {option} {example}") from None
    if not (abs(x) < 1e6 and abs(y) < 1e6):  # false for NaN too
        raise InvalidRequest(f"{option} {text!r} is out of range", hint="give finite numbers")
    return x, y
