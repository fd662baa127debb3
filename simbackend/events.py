"""When something happens in the simulated world while it runs, and how far a motion of the panel has come."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.simulated_events import EventSection, When
from simbackend.wire import Op

STEP_S = 0.01  # a moving panel is set to a new pose at this interval


@dataclass(slots=True, eq=False)
class NearTriggers:
    """Actions that wait until the finger tips come near a point of the base frame, m."""

    waiting: list[tuple[float, Array, float, Callable[[], None]]] = field(default_factory=list)

    def check(self, tip_m: Array, now_s: float) -> None:
        """Run, and forget, the actions whose time and place have come."""
        due = [
            entry for entry in self.waiting if now_s >= entry[0] and float(np.linalg.norm(tip_m - entry[1])) <= entry[2]
        ]
        for entry in due:
            self.waiting.remove(entry)
            entry[3]()


def begin_when(world: Any, when: When, action: Callable[[], None]) -> None:
    """Run an action when its time has come, and when the tips are near its object if it names one.

    Args:
        world: a `WorldClient`.
    """
    if when.near is None:
        world.at(when.at_s + when.delay_s, action)
        return

    def delayed() -> None:
        world.at(world.frame.snapshot.stamp_s + when.delay_s, action)

    place = world.cell.panel.object(when.near).point_m
    pose = world.draws.panel_pose(world.cell.file.workspace, world.cell.file.simulation)
    world.near.waiting.append((when.at_s, pose.apply(np.asarray(place)), when.near_m, delayed))


def schedule(world: Any) -> None:
    """Schedule the events of the cell file in a `WorldClient`."""
    for index, event in enumerate(world.cell.file.simulation.events):

        def begin(index: int = index, event: EventSection = event) -> None:
            steps = max(1, round(event.duration_s / STEP_S)) if event.kind == "panel-moves" else 1
            now_s = world.frame.snapshot.stamp_s
            for k in range(1, steps + 1):
                world.at(now_s + (k - 1) * STEP_S, partial(world.ask, Op.EVENT, index, k / steps))

        begin_when(world, event, begin)


def displacement(event: EventSection, fraction: float) -> RigidTransform:
    """Return where the panel is, in its own first frame, after a fraction of the motion of an event."""
    turn = Rotation.from_rotvec(fraction * np.asarray(event.turn_rad))
    about = np.asarray(event.about_m)
    return RigidTransform.from_components(about - turn.apply(about) + fraction * np.asarray(event.shift_m), turn)
