"""`panelwright calibrate depth`: measures how a range camera bends flat walls, from recordings, without a cell."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from hal.errors import InvalidRequest
from service.commands.common import console
from service.commands.range import Centre, Focal, Scale, reading_of


def depth(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="Recordings (npz, npy, PNG or TIFF) of a flat wall that fills the image, at several distances."
        ),
    ],
    *,
    device: Annotated[str, typer.Option(help="Name of the range camera in the cell file.")] = "range_scanner",
    out: Annotated[
        Path,
        typer.Option(help="Calibration record to write; if it exists, its mount is kept and its version increased."),
    ],
    scale: Scale = None,
    focal: Focal = None,
    centre: Centre = None,
) -> None:
    """Measure the slowly varying error of a range camera, and write it into the camera's calibration record."""
    from hal.calibration import load_calibration
    from perception.calibration import calibrate_depth, record_of, renewed, to_toml
    from perception.range import PinholeSensor, load_recording

    reading = reading_of(scale, None, None, focal, centre, None)
    loaded = [load_recording(recording, reading=reading) for recording in recordings]
    sensors = {sensor for _, sensor in loaded}
    sensor = next(iter(sensors))
    if len(sensors) > 1 or not isinstance(sensor, PinholeSensor):
        raise InvalidRequest(
            "the recordings are not all of one pinhole camera", hint="use one camera and resolution, or give --focal"
        )
    found = calibrate_depth([image for image, _ in loaded], (sensor.fx_px, sensor.fy_px), (sensor.cx_px, sensor.cy_px))
    present = load_calibration(out) if out.exists() else None
    record = record_of(device, found, date=time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()))
    record = record if present is None else renewed(present, record)
    over = None if present is None else out.read_text(encoding="utf-8")
    out.write_text(to_toml(record, over=over), encoding="utf-8")
    console.print(
        f"{found.walls} walls: at 1 m they are bent by {1e3 * found.before:.2f} mm (RMS), and by {1e3 * found.after:.2f} mm"
        " without the bend; at 2 m by four times as much",
        markup=False,
    )
    console.print(f"wrote {out}, version {record.version}", markup=False)
