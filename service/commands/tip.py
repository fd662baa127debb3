"""`panelwright calibrate tip`: finds the tool centre point from flange poses at which the tip touched one point."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Annotated

import typer

from hal.errors import InvalidRequest
from service.commands.common import console


def tip(
    poses: Annotated[
        Path,
        typer.Argument(help="Text file: X Y Z (m) RX RY RZ (rad) of the flange per touch, as the pendant shows them."),
    ],
    *,
    out: Annotated[Path, typer.Option(help="Calibration record of the gripper, whose mount is measured.")],
) -> None:
    """Find the tip of the tool from touches of one fixed point, and write it into the gripper's record."""
    import numpy as np
    from scipy.spatial.transform import RigidTransform, Rotation

    from hal.calibration import MountRecord, load_calibration
    from perception.calibration import calibrate_tip, renewed, to_toml

    present = load_calibration(out)
    rows = rows_of(poses, columns=6, hint="X Y Z in metres, RX RY RZ in rad")
    flanges = [RigidTransform.from_components(row[:3], Rotation.from_rotvec(row[3:])) for row in rows]
    found = calibrate_tip(flanges)
    x, y, z = (float(v) for v in found.flange_from_tip_m)
    sx, sy, sz = (float(s) for s in np.sqrt(np.diag(found.covariance_m2)))
    before = present.mount or MountRecord(position_m=(0.0, 0.0, 0.0), rpy_rad=(0.0, 0.0, 0.0))
    mount = before.model_copy(update={"position_m": (x, y, z), "sigma_m": (sx, sy, sz), "correlations": ()})
    measured = present.model_copy(
        update={
            "mount": mount,
            "intrinsics": None,
            "load": None,
            "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "method": f"tip by {len(rows)} touches of one point; directions as before",
            "quality": {"rms_m": found.rms_m, "touches": float(len(rows))},
        }
    )
    record = renewed(present, measured)
    out.write_text(to_toml(record, over=out.read_text(encoding="utf-8")), encoding="utf-8")
    console.print(
        f"tip at ({1e3 * x:.2f}, {1e3 * y:.2f}, {1e3 * z:.2f}) mm in the flange frame, one sigma"
        f" ({1e3 * sx:.2f}, {1e3 * sy:.2f}, {1e3 * sz:.2f}) mm, scatter {1e3 * found.rms_m:.2f} mm",
        markup=False,
    )
    console.print(f"wrote {out}, version {record.version}", markup=False)


def rows_of(path: Path, *, columns: int, hint: str) -> list[list[float]]:
    """Return the numbers of each line; empty lines and lines that begin with # are left out.

    Args:
        columns: numbers of a line, the first three in metres, at most 20.
        hint: what a line should have.

    Raises:
        InvalidRequest: a line has something else.
    """
    rows = []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        words = line.replace(",", " ").replace(";", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not all(map(math.isfinite, row)) or max(abs(value) for value in row[:3]) > 20.0:
            raise InvalidRequest(
                f"{path}, line {number}: {line.strip()!r} has not {columns} plausible numbers", hint=hint
            )
        rows.append(row)
    return rows
