"""Sweep a line scanner with the wrist: its lines become the depth image that a range camera would have taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.clock import Deadline, WallClock
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import NotFound, StaleReading, Unsupported
from hal.readings import Cause, Quality, Stamped
from manipulation import plan_sweep
from perception.range import image_from_sweep
from service.operations.session import Session
from service.operations.travel import kinematics, skill_context

LEAST_LINES, MOST_LINES = 96, 160  # of an image; a scanner with coarse steps is swept more finely than it looks
LONGEST_SWEEP_S = 30.0
READ_S = 5.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweptImage:
    """What a sweep gave.

    Attributes:
        depth_m: (H, W), NaN where nothing was seen, as from a range camera in the pose before the sweep.
        capabilities: of that camera.
        newest: the last scan.
    """

    depth_m: NDArray[np.float32]
    capabilities: RangeScannerCapabilities
    newest: Stamped[RangeImage]


def sweep_scanner(session: Session, name: str, device: Any) -> SweptImage:
    """Sweep the line scanner `name` about the pose in which the arm stands, and return to it.

    Raises:
        Unsupported: its driver keeps no scans.
        Unreachable: the wrist has no room to sweep.
        NotFound: no scan came during the sweep.
    """
    if not hasattr(device, "start_recording"):
        raise Unsupported(
            f"{name} is a line scanner whose driver keeps no scans for a sweep",
            hint="its driver needs start_recording and end_recording (hal.devices.SweptScanner)",
            device=name,
        )
    c: RangeScannerCapabilities = device.capabilities()
    state, mount = session.mover.state(), session.mount(name).parent_from_child
    sweep = plan_sweep(
        skill_context(session),
        mount,
        rate_rad_per_s=sweep_rate_rad_per_s(c),
        start_rad=state.position_rad,
        width_m=state.gripper_width_m,
    )
    session.run(sweep.out)
    device.start_recording(deadline=Deadline.after(WallClock(), READ_S))
    report = session.run(sweep.across)
    scans = device.end_recording(deadline=Deadline.after(WallClock(), READ_S))
    session.run(sweep.back)
    _refuse_frozen_lines(name, scans)
    good = [scan for scan in scans if scan.quality is not Quality.INVALID]
    if not good:
        raise NotFound(f"{name} gave no valid line in a sweep of {report.duration_s:.1f} s", hint=_rate_hint(c))
    arm = kinematics(session)
    depth_m, view = image_from_sweep(
        good,
        c,
        times_s=tuple(report.log.started_s + report.log.times_s),
        base_from_scanner=tuple(arm.tool(q, mount) for q in report.log.positions_rad),
        base_from_view=arm.tool(state.position_rad, mount),
        half_height_rad=sweep.half_rad,
    )
    as_camera = replace(
        c,
        projection="pinhole",
        width=view.width_px,
        height=view.height_px,
        fx=view.fx_px,
        fy=view.fy_px,
        cx=view.cx_px,
        cy=view.cy_px,
    )
    return SweptImage(depth_m=depth_m.astype(np.float32), capabilities=as_camera, newest=good[-1])


def sweep_rate_rad_per_s(c: RangeScannerCapabilities) -> float:
    """How fast the wrist turns: one step of the beams per line, within a sensible number of lines and time."""
    span_rad = 0.96
    line_rad = np.clip(abs(c.step_angle_rad), span_rad / MOST_LINES, span_rad / LEAST_LINES)
    return float(max(line_rad * c.rate_hz, span_rad / LONGEST_SWEEP_S))


def _refuse_frozen_lines(name: str, scans: Sequence[Stamped[RangeImage]]) -> None:
    """Two lines of a live scanner are never equal to the last bit, least of all while it turns."""
    lines = {np.nan_to_num(scan.value.depth_m).tobytes() for scan in scans if np.isfinite(scan.value.depth_m).any()}
    if len(scans) > 1 and len(lines) == 1:
        raise StaleReading(
            f"{name} repeats the same line during a sweep",
            hint=f"{name} is frozen: power-cycle it; nothing was measured with the old line",
            device=name,
            cause=str(Cause.FROZEN),
        )


def _rate_hint(c: RangeScannerCapabilities) -> str:
    return f"it should give {c.rate_hz:.0f} lines a second: look at GET /v1/devices, and that it looks at the panel"
