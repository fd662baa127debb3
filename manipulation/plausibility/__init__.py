"""Plausibility checks: readings of devices compared with each other, with commands and with geometry.

The functions do not read devices or raise. They take readings and return a `Finding` or None for the caller to report.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from manipulation.plausibility.finding import Finding, Symptom
    from manipulation.plausibility.proximity import ProximityMonitor
    from manipulation.plausibility.repetition import FrameDigest, repeated_frame

__all__ = ["Finding", "FrameDigest", "ProximityMonitor", "Symptom", "repeated_frame"]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
