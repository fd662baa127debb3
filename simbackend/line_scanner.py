"""`sim:range_scanner` with `model = "polar"`: a line scanner that rotates steadily and is swept by the wrist."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.clock import Deadline
from hal.devices import DeviceKind, RangeImage, RangeScannerCapabilities
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context
from hal.simulated import Fault
from simbackend.client import CameraView, Frame, true_mount
from simbackend.device import VALID, SimDevice
from simbackend.range_sensor import MAX_RANGE_M, MIN_RANGE_M, Depth, RangeOptions, corrupt

OVERSAMPLING = 4  # rendered columns per beam; between two columns on one plane the range is exact


class SimLineScanner(SimDevice[RangeImage]):
    """Line scanner on the flange: `width` beams in its x-z plane, `line_rate_hz` turns per second.

    While recording, it measures each beam in the tick that the beam belongs to. A single reading is measured in one
    tick, as if the arm were at rest.
    """

    def __init__(self, context: Context, options: RangeOptions) -> None:
        super().__init__(context, DeviceKind.RANGE_SCANNER, options)
        self._options = options
        self._step_rad = options.field_of_view_rad / (options.width - 1)
        self._angle_rad = (np.arange(options.width) - (options.width - 1) / 2.0) * self._step_rad
        columns = OVERSAMPLING * options.width
        focal = columns / 2.0 / math.tan(options.field_of_view_rad / 2.0 + self._step_rad)
        self._view = CameraView(
            flange_from_camera=true_mount(self._world.cell, self._world.draws, context.name),
            width=columns,
            height=1,
            focal=(focal, focal),
            centre=((columns - 1) / 2.0, 0.0),
            near_m=0.05,
        )
        self._column = focal * np.tan(self._angle_rad) + self._view.centre[0]
        self._kept_scans: list[Stamped[RangeImage]] | None = None
        self._parts: list[Depth] = []

    def capabilities(self) -> RangeScannerCapabilities:
        """Return geometry and limits."""
        return RangeScannerCapabilities(
            projection="polar",
            width=self._options.width,
            height=1,
            fx=1.0 / self._step_rad,
            fy=1.0,
            cx=(self._options.width - 1) / 2.0,
            cy=0.0,
            min_range_m=MIN_RANGE_M,
            max_range_m=MAX_RANGE_M,
            sigma_m=self._options.sigma_m,
            rate_hz=self._options.line_rate_hz,
            first_angle_rad=float(self._angle_rad[0]),
            step_angle_rad=self._step_rad,
        )

    def read_range(self, *, deadline: Deadline) -> Stamped[RangeImage]:
        """Return one line at the present tick."""
        return self._sample(deadline)

    def start_recording(self, *, deadline: Deadline) -> None:
        """Keep every scan that ends from now on."""
        self._check(deadline)
        self._kept_scans, self._parts = [], []
        self._await_next_scan(self._world.frame.snapshot.tick)

    def end_recording(self, *, deadline: Deadline) -> tuple[Stamped[RangeImage], ...]:
        """Return the scans since `start_recording`, oldest first."""
        kept, self._kept_scans = self._kept_scans, None
        self._check(deadline)
        return tuple(kept or ())

    def _measure(self, frame: Frame, bias: float) -> tuple[RangeImage, Quality, Cause]:
        return self._corrupted(frame, self._line_m() + np.float32(bias)), *VALID

    def _corrupted(self, frame: Frame, line_m: Depth) -> RangeImage:
        random = self._world.draws.at_tick(self._name, frame.snapshot.tick)
        return RangeImage(depth_m=corrupt(line_m[np.newaxis, :], self._options, random))

    def _line_m(self) -> Depth:
        """Return the (width,) true range along each beam at the present tick, NaN where it meets no surface."""
        _, depth_m = self._world.depth_m(self._view)
        low = np.floor(self._column).astype(int)
        left, right, fraction = depth_m[0, low], depth_m[0, low + 1], self._column - low
        with np.errstate(invalid="ignore"):
            between = 1.0 / ((1.0 - fraction) / left + fraction / right)  # exact on a plane
            nearer_column = np.where(fraction < 0.5, left, right)
            is_one_surface = np.abs(left - right) < 0.02 * nearer_column
        along = np.where(is_one_surface, between, nearer_column) / np.cos(self._angle_rad)
        return np.asarray(along, np.float32)

    # -- recording: one event of the world for each tick in which beams are measured ---------------------------------

    @property
    def _beam_ticks(self) -> NDArray[np.int64]:
        """Return, for each beam, how many ticks before the end of a scan it is measured; the last is zero."""
        before = np.arange(self._options.width)[::-1] * self._step_rad / math.tau
        ticks: NDArray[np.int64] = np.rint(before * self._world.rate_hz / self._options.line_rate_hz).astype(np.int64)
        return ticks

    def _await_next_scan(self, tick: int) -> None:
        """Schedule the ticks of the next scan whose first beam comes after `tick`."""
        beam_ticks, kept = self._beam_ticks, self._kept_scans
        period = self._world.rate_hz / self._options.line_rate_hz
        end = round(math.ceil((tick + 1 + beam_ticks[0]) / period) * period)
        for ahead in np.unique(beam_ticks)[::-1]:
            self._world.at((end - int(ahead)) / self._world.rate_hz, lambda: self._measure_part(end, kept))

    def _measure_part(self, end: int, kept: list[Stamped[RangeImage]] | None) -> None:
        """Measure the beams of the present tick; the last of them completes the scan.

        Args:
            kept: the recording that this tick was planned for; it may have ended, and another one begun.
        """
        if self._kept_scans is None or self._kept_scans is not kept:
            return
        frame = self._world.frame
        ahead = end - frame.snapshot.tick
        self._parts.append(np.where(self._beam_ticks == ahead, self._line_m(), np.float32(0.0)))
        if ahead > 0:
            return
        line_m, self._parts = np.sum(self._parts, axis=0, dtype=np.float32), []
        self._await_next_scan(end)
        if self._fault is Fault.STALE:
            return
        if self._kept is not None:  # the device is frozen
            scan = self._kept.value
        else:
            bias = self._magnitude if self._fault is Fault.BIASED else 0.0
            scan = self._corrupted(frame, np.asarray(line_m + bias, np.float32))
        self._kept_scans.append(self._stamp(frame, scan, *VALID))
