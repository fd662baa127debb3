"""`panelwright calibrate board`: calibrates a camera's lens from photographs of a printed board, without a cell."""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hal.errors import InvalidRequest, NotFound
from service.commands.common import console
from service.commands.teach import read_image

if TYPE_CHECKING:
    from perception.calibration import BoardView, Charuco, Dots


class BoardKind(StrEnum):
    """Patterns that a board can have."""

    CHARUCO = "charuco"
    DOTS = "dots"


def board(
    images: Annotated[list[Path], typer.Argument(help="Photographs of the board, all of one size; ten are enough.")],
    *,
    kind: Annotated[
        BoardKind, typer.Option(help="ChArUco (DICT_5X5_100) or a grid of black dots.")
    ] = BoardKind.CHARUCO,
    columns: Annotated[int, typer.Option(min=3, max=50, help="Number of squares (or dots) per row.")] = 9,
    rows: Annotated[int, typer.Option(min=3, max=50, help="Number of rows.")] = 6,
    pitch: Annotated[
        float, typer.Option(min=1e-4, max=1.0, help="Side of a square, or distance between dots, m.")
    ] = 0.03,
    marker: Annotated[float, typer.Option(min=1e-4, max=1.0, help="Side of a marker, m (ChArUco).")] = 0.022,
    device: Annotated[str, typer.Option(help="Name of the camera in the cell file.")] = "wrist_camera",
    out: Annotated[
        Path,
        typer.Option(help="Calibration record to write; if it exists, its mount is kept and its version increased."),
    ],
) -> None:
    """Calibrate focal lengths, centre and distortion, each with one sigma, and write a calibration record."""
    from hal.calibration import load_calibration
    from perception.calibration import Charuco, Dots, calibrate_camera, record_of, renewed, to_toml

    if kind is BoardKind.CHARUCO and marker >= pitch:
        raise InvalidRequest(f"markers of {marker} m do not fit squares of {pitch} m", hint="measure both, in metres")
    target: Charuco | Dots = (
        Charuco(columns=columns, rows=rows, square_m=pitch, marker_m=marker)
        if kind is BoardKind.CHARUCO
        else Dots(columns=columns, rows=rows, spacing_m=pitch)
    )
    present = load_calibration(out) if out.exists() else None
    views, size = _views(images, target)
    result = calibrate_camera(views, size)
    record = record_of(device, result, date=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()))
    if present is not None:
        record = renewed(present, record)
    out.write_text(to_toml(record), encoding="utf-8")
    sigma = record.quality
    lens = result.intrinsics
    console.print(f"{len(views)} of {len(images)} images used, residual {result.rms_px:.3f} px", markup=False)
    console.print(
        f"  fx {lens.fx_px:.2f} ± {sigma['sigma_fx']:.2f} px, fy {lens.fy_px:.2f} ± {sigma['sigma_fy']:.2f} px"
    )
    console.print(
        f"  cx {lens.cx_px:.2f} ± {sigma['sigma_cx']:.2f} px, cy {lens.cy_px:.2f} ± {sigma['sigma_cy']:.2f} px"
    )
    console.print(f"wrote {out}, version {record.version}", markup=False)


def _views(images: list[Path], target: Charuco | Dots) -> tuple[list[BoardView], tuple[int, int]]:
    """Find the board in each image; images without it are named on the terminal.

    Raises:
        InvalidRequest: the images differ in size.
        NotFound: fewer than three images show the board.
    """
    from perception.vision import as_gray

    found: list[BoardView] = []
    sizes: dict[tuple[int, int], Path] = {}
    why = ""
    for path in images:
        gray = as_gray(read_image(path))
        sizes.setdefault((gray.shape[1], gray.shape[0]), path)
        if len(sizes) > 1:
            words = " and ".join(f"{name.name} {w}x{h}" for (w, h), name in sizes.items())
            raise InvalidRequest(
                f"images of different sizes: {words}", hint="use images of one camera at one resolution"
            )
        try:
            found.append(target.find(gray))
        except NotFound as error:
            why = error.what
            console.print(f"left out {path}: {error.what}", markup=False)
    if len(found) < 3:
        raise NotFound(
            f"{len(found)} of {len(images)} images show the board; {why}",
            hint="take ten images, with the board tilted in all directions",
        )
    return found, next(iter(sizes))
