"""Operations that use every kind of device, for recordings."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel
from scipy.spatial.transform import RigidTransform

from hal.clock import Deadline, WallClock
from hal.motion import GripperMotion, Hold, JointTrajectory
from hal.strict import Strict
from service.operations import Operation, OperationContext
from tests.service import verbs


class LookRequest(Strict):
    """Moves to `to_rad` and looks `looks` times with everything; `by` is the name of the motion."""

    to_rad: float = 0.1
    looks: int = 2
    by: str = "turn"


class LookResult(BaseModel):
    """A number made of all readings, which changes when the last bit of one of them does."""

    digest: float
    stamps_s: list[float]
    flange: list[float]


def look(context: OperationContext, request: LookRequest) -> LookResult:
    """Move, look with every device, and return what was seen."""
    connection, mover = context.connection, context.connection.mover
    context.task.progress(0.1, "turn")
    q = mover.state().position_rad
    mover.execute(_turn(request.by, q, request.to_rad))
    mover.execute(GripperMotion(name="open", width_m=0.05, force_n=10.0, must_arrive=False))
    mover.execute(Hold(name="settle", duration_s=0.02))
    seen: list[Any] = []
    for _ in range(request.looks):
        connection.device("panel_lights").set_on((True, False, True, False), deadline=_soon())
        image = connection.device("wrist_camera").read_image(deadline=_soon())
        ranges = connection.device("range_scanner").read_range(deadline=_soon())
        near = connection.device("finger_proximity").read_distance_m(deadline=_soon())
        wrench = connection.device("wrist_ft").read_wrench(deadline=_soon())
        seen += [image, ranges, near, wrench]
    context.task.progress(0.9, "think")
    digest = sum(float(np.nansum(np.sin(np.asarray(_values(one.value), float)))) for one in seen)
    pose: RigidTransform = mover.state().base_from_flange
    stamps = [connection.clock.now_s(), *(one.host_time_s for one in seen)]
    return LookResult(digest=digest, stamps_s=stamps, flange=pose.as_matrix().ravel().tolist())


def _turn(name: str, q: Any, by_rad: float) -> JointTrajectory:
    times = np.linspace(0.0, 0.4, 5)
    shape = 0.5 - 0.5 * np.cos(np.pi * times / times[-1])
    slope = 0.5 * np.pi / times[-1] * np.sin(np.pi * times / times[-1])
    first = np.eye(1, len(q))
    return JointTrajectory(
        name=name,
        times_s=times,
        positions_rad=q + by_rad * shape[:, None] * first,
        velocities_rad_per_s=by_rad * slope[:, None] * first,
    )


def _soon() -> Deadline:
    return Deadline.after(WallClock(), 5.0)


def _values(value: Any) -> Any:
    for name in ("pixels", "depth_m", "force_n"):
        if hasattr(value, name):
            return getattr(value, name)
    return value


OPERATIONS = {
    **verbs.OPERATIONS,
    "look": Operation(
        name="look", request_model=LookRequest, result_model=LookResult, run=look, summary="Look with everything"
    ),
}
