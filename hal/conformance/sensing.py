"""Contracts of cameras, range scanners, proximity, touch and force/torque sensors."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hal.camera_settings import AdjustableExposure
from hal.conformance.device import DeviceContract, level
from hal.conformance.rig import Level, Rig
from hal.devices import Camera, DeviceKind, ForceTorque, Proximity, RangeScanner, SweptScanner, Touch
from hal.errors import InvalidRequest
from hal.readings import Quality, Stamped

EXPOSURE_STEP = 0.1  # cameras count in steps: V4L2 in 100 us


class CameraContract(DeviceContract[Camera]):
    """Contract of a camera: frames of the stated size whose exposure began after the call."""

    kind = DeviceKind.CAMERA

    def read(self, rig: Rig[Camera], duration_s: float = 2.0) -> Stamped[Any]:
        """Read a frame."""
        return rig.device.read_image(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Camera], value: Any) -> None:
        """Check that size, pixel depth and colour are as the capabilities state."""
        c = rig.device.capabilities()
        shape = (c.height_px, c.width_px, 3) if c.is_colour else (c.height_px, c.width_px)
        assert value.pixels.shape == shape
        assert value.pixels.dtype == np.uint8

    @level(Level.STATIC)
    def test_the_nominal_lens_fits_the_image(self, rig: Rig[Camera]) -> None:
        c = rig.device.capabilities()
        assert (c.nominal.width_px, c.nominal.height_px) == (c.width_px, c.height_px)
        assert c.nominal.fx_px > 0 and c.nominal.fy_px > 0

    @level(Level.READ)
    def test_an_exposure_that_is_set_is_that_of_the_next_frame(self, rig: Rig[Camera]) -> None:
        range_s = rig.device.capabilities().settings.exposure_range_s
        if range_s is None:
            pytest.skip("the exposure of this camera cannot be set")
        assert isinstance(rig.device, AdjustableExposure)
        before_s = self.read(rig).value.exposure_s
        try:
            for factor in (0.5, 0.8):
                wanted_s = min(max(range_s[0], factor * before_s), range_s[1])
                rig.device.set_exposure(wanted_s, deadline=rig.deadline())
                assert self.read(rig).value.exposure_s == pytest.approx(wanted_s, rel=EXPOSURE_STEP)
            for wrong_s in (0.5 * range_s[0], 2.0 * range_s[1]):
                with pytest.raises(InvalidRequest):
                    rig.device.set_exposure(wrong_s, deadline=rig.deadline())
        finally:
            rig.device.set_exposure(before_s, deadline=rig.deadline())
        assert self.read(rig).value.exposure_s == pytest.approx(before_s, rel=EXPOSURE_STEP)


class RangeScannerContract(DeviceContract[RangeScanner]):
    """Contract of a range scanner: range images in metres, NaN where nothing was measured."""

    kind = DeviceKind.RANGE_SCANNER

    def read(self, rig: Rig[RangeScanner], duration_s: float = 2.0) -> Stamped[Any]:
        """Read a range image."""
        return rig.device.read_range(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[RangeScanner], value: Any) -> None:
        """Check that the shape is as stated and that the ranges are NaN or within the sensor's limits."""
        c = rig.device.capabilities()
        assert value.depth_m.shape == (c.height, c.width)
        assert value.depth_m.dtype == np.float32
        seen = value.depth_m[np.isfinite(value.depth_m)]
        assert not np.any(np.isinf(value.depth_m))
        assert np.all((seen >= 0.5 * c.min_range_m) & (seen <= 1.1 * c.max_range_m))

    @level(Level.READ)
    def test_a_line_scanner_keeps_every_scan_of_a_recording(self, rig: Rig[RangeScanner]) -> None:
        c = rig.device.capabilities()
        if not c.needs_sweep:
            pytest.skip("the scanner returns whole images and records no single scans")
        assert isinstance(rig.device, SweptScanner)
        rig.device.start_recording(deadline=rig.deadline())
        began_s = rig.clock.now_s()
        rig.clock.sleep(5.0 / c.rate_hz)
        scans = rig.device.end_recording(deadline=rig.deadline())
        stamps_s = [scan.host_time_s for scan in scans]
        assert len(scans) >= 2 and stamps_s == sorted(set(stamps_s))
        assert stamps_s[-1] > began_s
        for scan in scans:
            self.check_value(rig, scan.value)


class ProximityContract(DeviceContract[Proximity]):
    """Contract of a proximity sensor: a distance, or an invalid reading if nothing is in range."""

    kind = DeviceKind.PROXIMITY

    def read(self, rig: Rig[Proximity], duration_s: float = 2.0) -> Stamped[Any]:
        """Read the distance."""
        return rig.device.read_distance_m(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Proximity], value: Any) -> None:
        """Check that the distance is within the measuring range."""
        c = rig.device.capabilities()
        assert isinstance(value, float)
        assert c.min_range_m - 5 * c.sigma_m <= value <= c.max_range_m + 5 * c.sigma_m

    @level(Level.READ)
    def test_nothing_in_range_is_invalid_and_not_a_number(self, rig: Rig[Proximity]) -> None:
        sample = self.read(rig)
        assert math.isfinite(sample.value) or sample.quality is Quality.INVALID


class TouchContract(DeviceContract[Touch]):
    """Contract of touch switches: one state per channel."""

    kind = DeviceKind.TOUCH

    def read(self, rig: Rig[Touch], duration_s: float = 2.0) -> Stamped[Any]:
        """Read all switches."""
        return rig.device.read_contacts(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[Touch], value: Any) -> None:
        """Check that there is one bool per channel."""
        assert len(value) == len(rig.device.capabilities().channels)
        assert all(isinstance(contact, bool) for contact in value)


class ForceTorqueContract(DeviceContract[ForceTorque]):
    """Contract of a force/torque sensor: a raw wrench."""

    kind = DeviceKind.FORCE_TORQUE

    def read(self, rig: Rig[ForceTorque], duration_s: float = 2.0) -> Stamped[Any]:
        """Read the wrench."""
        return rig.device.read_wrench(deadline=rig.deadline(duration_s))

    def check_value(self, rig: Rig[ForceTorque], value: Any) -> None:
        """Check that the wrench is finite and within the measuring range."""
        c = rig.device.capabilities()
        assert value.force_n.shape == value.torque_nm.shape == (3,)
        assert np.all(np.abs(value.force_n) <= c.force_range_n) and np.all(np.abs(value.torque_nm) <= c.torque_range_nm)
