"""The facts that the cell has measured so far: the panel's pose, and the newest readings and frames.

The facts are one frozen value that is replaced as a whole under a lock, so that a reader in another thread never sees
half of a change.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hal.config import Cell
from hal.geometry import UncertainPose, transform_rpy

if TYPE_CHECKING:
    from manipulation import CollisionBox, Kinematics
    from manipulation.plausibility import FrameDigest
    from perception.vision import ObjectReading


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Facts:
    """Everything that is known about the cell and the panel in front of it.

    Attributes:
        base_from_panel: pose of the panel with covariance; None until the panel has been located.
        readings: newest conclusive reading of each object, by the object's name.
        frames: newest frame of each camera and range scanner, by the device's name.
        turned_rad: angle with its whole turns, by name, of each wheel that was turned; a look shows one turn only.
        obstacles: boxes in the base frame around what stands before the panel; None until it was looked for.
        kinematics: of the cell's arm; None until first needed.
    """

    base_from_panel: UncertainPose | None = None
    readings: Mapping[str, ObjectReading] = field(default_factory=lambda: MappingProxyType({}))
    frames: Mapping[str, FrameDigest] = field(default_factory=lambda: MappingProxyType({}))
    turned_rad: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    obstacles: tuple[CollisionBox, ...] | None = None
    kinematics: Kinematics | None = None


class WorldModel:
    """The cell's facts and the only ways to change them; safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._facts = Facts()

    @property
    def base_from_panel(self) -> UncertainPose | None:
        """Estimated pose of the panel, with covariance; None until it has been located."""
        return self._facts.base_from_panel

    @property
    def readings(self) -> Mapping[str, ObjectReading]:
        """The newest conclusive reading of each object, by name."""
        return self._facts.readings

    def believe_panel(self, base_from_panel: UncertainPose) -> None:
        """Store `base_from_panel` as the estimated pose of the panel."""
        self._change(lambda facts: replace(facts, base_from_panel=base_from_panel))

    def forget_panel(self) -> None:
        """Drop the panel's pose, because the calibration that it was measured with has changed."""
        self._change(lambda facts: replace(facts, base_from_panel=None, obstacles=None))

    def note_readings(self, readings: Iterable[ObjectReading]) -> None:
        """Store the conclusive readings in place of earlier ones of the same objects."""
        answered = {reading.name: reading for reading in readings if reading.answered}
        self._change(lambda facts: replace(facts, readings=MappingProxyType({**facts.readings, **answered})))

    def forget_reading(self, name: str) -> None:
        """Drop the reading of an object, because its state may have changed or the reading is in doubt."""
        self._change(
            lambda facts: replace(
                facts, readings=MappingProxyType({known: r for known, r in facts.readings.items() if known != name})
            )
        )

    @property
    def turned_rad(self) -> Mapping[str, float]:
        """The angle with its whole turns of each wheel that was turned, by name."""
        return self._facts.turned_rad

    def note_turned(self, name: str, angle_rad: float) -> None:
        """Store the angle, with its whole turns, to which a wheel was turned."""
        self._change(lambda facts: replace(facts, turned_rad=MappingProxyType({**facts.turned_rad, name: angle_rad})))

    @property
    def obstacles(self) -> tuple[CollisionBox, ...] | None:
        """Boxes in the base frame around what stands before the panel; None until it was looked for."""
        return self._facts.obstacles

    def note_obstacles(self, boxes: tuple[CollisionBox, ...] | None) -> None:
        """Store what stands before the panel in place of what was found earlier; None if it is to be looked for again."""
        self._change(lambda facts: replace(facts, obstacles=boxes))

    def note_frame(self, device: str, frame: FrameDigest) -> FrameDigest | None:
        """Store the newest frame of a sensor; returns the previous one."""
        before = self._change(lambda facts: replace(facts, frames=MappingProxyType({**facts.frames, device: frame})))
        return before.frames.get(device)

    def kinematics(self, make: Callable[[], Kinematics]) -> Kinematics:
        """Return the arm's kinematics, which are built once."""
        known = self._facts.kinematics
        if known is None:
            known = make()
            self._change(lambda facts: replace(facts, kinematics=known))
        return known

    def forget(self) -> None:
        """Drop all facts but the whole turns of wheels, because the panel or the arm may have been exchanged.

        No look shows whole turns; a skill believes them as long as a look does not contradict them.
        """
        self._change(lambda facts: Facts(turned_rad=facts.turned_rad))

    def _change(self, change: Callable[[Facts], Facts]) -> Facts:
        """Replace the facts by the result of `change`; returns the previous facts."""
        with self._lock:
            before = self._facts
            self._facts = change(before)
            return before


def expected_panel(cell: Cell) -> UncertainPose:
    """Return `base_from_panel` from the cell file, whose tolerances count as three standard deviations."""
    w = cell.file.workspace
    sigma = np.repeat([w.position_tolerance_m / 3.0, w.angle_tolerance_rad / 3.0], 3)
    pose = transform_rpy(w.panel_position_m, w.panel_rpy_rad)
    return UncertainPose(parent_from_child=pose, covariance=np.diag(sigma**2))
