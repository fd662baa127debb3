"""What is believed of the panel: its newest pose, or where the cell file expects it; and what its objects last said."""

from __future__ import annotations

import numpy as np

from hal.geometry import UncertainPose, transform_rpy
from perception.vision import ObjectReading
from service.operations.session import Session

READINGS = "readings"  # key in the cell's memory: newest reading by object


def expected_panel(session: Session) -> UncertainPose:
    """Where the cell file expects the panel; its tolerances count as three sigma."""
    w = session.cell.file.workspace
    sigma = np.repeat([w.position_tolerance_m / 3.0, w.angle_tolerance_rad / 3.0], 3)
    pose = transform_rpy(w.panel_position_m, w.panel_rpy_rad)
    return UncertainPose(parent_from_child=pose, covariance=np.diag(sigma**2))


def believed_panel(session: Session) -> UncertainPose:
    """The newest pose, or what the cell file expects."""
    return session.memory.base_from_panel or expected_panel(session)


def known_readings(session: Session) -> dict[str, ObjectReading]:
    """The newest reading of every object, by name."""
    return dict(session.memory.recall(READINGS) or {})


def forget_reading(session: Session, name: str) -> None:
    """What an object said before it was worked is no guide to what it says now."""
    session.memory.remember(READINGS, {k: v for k, v in known_readings(session).items() if k != name})
