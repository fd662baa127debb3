"""`panelwright calibrate zero`: finds the zero of a proximity sensor from readings at known distances of a plate."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hal.errors import InvalidRequest
from service.commands.common import console
from service.commands.tip import rows_of

if TYPE_CHECKING:
    from hal.calibration import CalibrationRecord, MountRecord


def zero(
    readings: Annotated[
        Path,
        typer.Argument(help="Text file: DISTANCE READING (m) a line, from the fingertips and of the sensor."),
    ],
    *,
    out: Annotated[Path, typer.Option(help="Calibration record of the sensor, whose mount is measured.")],
    gripper: Annotated[Path, typer.Option(help="Calibration record of the gripper, whose mount is the fingertips.")],
) -> None:
    """Find how far a proximity sensor sits behind the fingertips, and write it into the sensor's record."""
    import numpy as np

    from hal.calibration import load_calibration
    from perception.calibration import calibrate_zero, renewed, to_toml

    present = load_calibration(out)
    before, tip = (_mount(record, path) for record, path in ((present, out), (load_calibration(gripper), gripper)))
    rows = np.array(rows_of(readings, columns=2, hint="the distance and the reading, in metres")).reshape(-1, 2)
    found = calibrate_zero(rows[:, 0], rows[:, 1], mount=before, tip=tip)
    (x, y, _), (sx, sy, _) = before.position_m, before.sigma_m
    mount = before.model_copy(
        update={"position_m": (x, y, found.z_m), "sigma_m": (sx, sy, found.sigma_m), "correlations": ()}
    )
    measured = present.model_copy(
        update={
            "mount": mount,
            "intrinsics": None,
            "load": None,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "method": f"zero by {len(rows)} readings against a plate; place across the beam as before",
            "quality": {"rms_m": found.rms_m, "readings": float(len(rows)), "scale": found.scale},
        }
    )
    record = renewed(present, measured)
    out.write_text(to_toml(record, over=out.read_text(encoding="utf-8")), encoding="utf-8")
    behind_m = tip.position_m[2] - found.z_m
    console.print(
        f"the sensor's zero is {1e3 * behind_m:.2f} mm behind the fingertips, one sigma {1e3 * found.sigma_m:.2f} mm,"
        f" scatter {1e3 * found.rms_m:.2f} mm",
        markup=False,
    )
    console.print(f"wrote {out}, version {record.version}", markup=False)


def _mount(record: CalibrationRecord, path: Path) -> MountRecord:
    if record.mount is None:
        raise InvalidRequest(f"{path} has no [mount]", hint="add position_m and rpy_rad by a ruler")
    return record.mount
