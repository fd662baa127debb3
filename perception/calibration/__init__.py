"""Calibration of camera mount, scanner mount, lens, bend of depth and tool load from the cell's own measurements.

The module `calibration_poses` proposes the poses to measure from.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from perception.calibration.boards import BoardView, Charuco, Dots
    from perception.calibration.depth_bend import calibrate_depth
    from perception.calibration.in_hand import InHandCalibration, calibrate_in_hand, propose_view
    from perception.calibration.in_hand_model import UNKNOWN_LENS, Beforehand, InHandState, InHandView
    from perception.calibration.intrinsics import calibrate_camera
    from perception.calibration.records import record_of, renewed, to_toml
    from perception.calibration.scanner import ScannerCalibration, ScannerView, calibrate_scanner
    from perception.calibration.tip import calibrate_tip
    from perception.calibration.wrench import WrenchCalibration, calibrate_wrench
    from perception.calibration.zero import calibrate_zero

__all__ = [
    "UNKNOWN_LENS",
    "Beforehand",
    "BoardView",
    "Charuco",
    "Dots",
    "InHandCalibration",
    "InHandState",
    "InHandView",
    "ScannerCalibration",
    "ScannerView",
    "WrenchCalibration",
    "calibrate_camera",
    "calibrate_depth",
    "calibrate_in_hand",
    "calibrate_scanner",
    "calibrate_tip",
    "calibrate_wrench",
    "calibrate_zero",
    "propose_view",
    "record_of",
    "renewed",
    "to_toml",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
