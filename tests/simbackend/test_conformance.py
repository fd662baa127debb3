"""Every simulated device of the bench cell fulfils the contract of its kind."""

from __future__ import annotations

from typing import Any

import pytest

from hal.conformance import (
    ArmContract,
    CameraContract,
    ForceTorqueContract,
    GripperContract,
    LightsContract,
    ProximityContract,
    RangeScannerContract,
    Rig,
    TouchContract,
)
from tests.simbackend.rig import SimCell, injector


def rig_of(bench: SimCell, name: str) -> Rig[Any]:
    device = bench.connect(name)
    return Rig(device=device, clock=bench.clock, sample_period_s=0.01, inject=injector(device))


class TestSimArm(ArmContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "arm")


class TestSimGripper(GripperContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "gripper")


class TestSimCamera(CameraContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "wrist_camera")


class TestSimRangeScanner(RangeScannerContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "range_scanner")


class TestSimLineScanner(RangeScannerContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        device = bench.connect("range_scanner", model="polar")
        return Rig(device=device, clock=bench.clock, sample_period_s=0.01, inject=injector(device))


class TestSimProximity(ProximityContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "proximity_left")


class TestSimTouch(TouchContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "finger_touch")


class TestSimForceTorque(ForceTorqueContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "wrist_ft")


class TestSimLights(LightsContract):
    @pytest.fixture
    def rig(self, bench: SimCell) -> Rig[Any]:
        return rig_of(bench, "panel_lights")
