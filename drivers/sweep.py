"""A line scanner on the moving wrist: each beam is placed where the wrist was when it was measured.

    base_point = base_from_wrist(t) wrist_from_scanner r (sin a, 0, cos a),   t = end of scan - (1 - a's part of a turn) T

`perception/range/from_points.py` makes an image of depths of the points.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import InvalidRequest, StaleReading
from hal.geometry import interpolate
from hal.readings import Quality, Stamped

Points = Array
LONGEST_GAP_S = 0.1  # between two poses: at 1 m/s^2 the path bends 1.3 mm away from the straight line meanwhile
KNOTS = 9  # poses a scan; beams between two of them are placed by interpolation


@dataclass(frozen=True, slots=True, eq=False)
class PoseTrack:
    """Where the wrist was: times in seconds on the cell's clock, rising, and `base_from_wrist` at each."""

    times_s: Sequence[float]
    base_from_wrist: Sequence[RigidTransform]

    def at(self, time_s: float) -> RigidTransform:
        """The pose at a time between two known ones.

        Raises:
            StaleReading: outside the track, or in a gap of it.
        """
        after = bisect_left(self.times_s, time_s)
        if after < len(self.times_s) and self.times_s[after] == time_s:
            return self.base_from_wrist[after]
        if not 0 < after < len(self.times_s):
            raise StaleReading("no arm pose from the time of the scan", hint="record poses before and after the sweep")
        start_s, end_s = self.times_s[after - 1], self.times_s[after]
        if end_s - start_s > LONGEST_GAP_S:
            gap = f"{end_s - start_s:.2f} s"
            raise StaleReading(f"arm poses have a gap of {gap} at the time of the scan", hint="read the arm more often")
        fraction = (time_s - start_s) / (end_s - start_s)
        return interpolate(self.base_from_wrist[after - 1], self.base_from_wrist[after], fraction)


def beam_times_s(end_s: float, c: RangeScannerCapabilities) -> Points:
    """When each beam was measured: the scanner turns steadily, and the last beam ends the scan.

    Args:
        end_s: stamp of the scan, as the drivers of line scanners give it.
    """
    before_s = (c.width - 1 - np.arange(c.width)) * abs(c.step_angle_rad) / (math.tau * c.rate_hz)
    return np.asarray(end_s - before_s, np.float64)


def scan_points(
    scan: Stamped[RangeImage], c: RangeScannerCapabilities, track: PoseTrack, wrist_from_scanner: RigidTransform
) -> Points:
    """The (n, 3) points of one scan in the base frame, in metres; beams that saw nothing are left out.

    Raises:
        InvalidRequest: not a line scanner's. StaleReading: the track does not cover the scan.
    """
    if c.projection != "polar":
        raise InvalidRequest("a sweep is made of lines", hint="a range camera's images need no sweep")
    range_m = scan.value.depth_m[0].astype(np.float64)
    if scan.quality is Quality.INVALID or not np.any(np.isfinite(range_m)):
        return np.empty((0, 3))
    angle_rad = c.first_angle_rad + np.arange(c.width) * c.step_angle_rad
    in_scanner = range_m[:, np.newaxis] * np.stack([np.sin(angle_rad), 0.0 * angle_rad, np.cos(angle_rad)], axis=1)
    seen = np.isfinite(range_m)
    return _moved(wrist_from_scanner.apply(in_scanner[seen]), beam_times_s(scan.host_time_s, c)[seen], track)


def _moved(in_wrist: Points, times_s: Points, track: PoseTrack) -> Points:
    """Points to the base frame, each with the pose of its own time: linear between knots, turned exactly."""
    knots_s = np.linspace(times_s[0], times_s[-1], KNOTS)
    poses = [track.at(float(knot_s)) for knot_s in knots_s]
    place = np.clip(np.searchsorted(knots_s, times_s) - 1, 0, KNOTS - 2)
    step_s = max(float(knots_s[1] - knots_s[0]), 1e-12)
    fraction = (times_s - knots_s[place]) / step_s
    shift_m = np.stack([pose.translation for pose in poses])
    turns = Rotation.concatenate([pose.rotation for pose in poses])
    delta = (turns[place].inv() * turns[place + 1]).as_rotvec()
    turn = turns[place] * Rotation.from_rotvec(delta * fraction[:, np.newaxis])
    translation_m = shift_m[place] + fraction[:, np.newaxis] * (shift_m[place + 1] - shift_m[place])
    return np.asarray(turn.apply(in_wrist) + translation_m)


def sweep_points(
    scans: Iterable[Stamped[RangeImage]],
    c: RangeScannerCapabilities,
    track: PoseTrack,
    wrist_from_scanner: RigidTransform,
) -> Points:
    """All points of a sweep in the base frame."""
    parts = [scan_points(scan, c, track, wrist_from_scanner) for scan in scans]
    return np.concatenate(parts) if parts else np.empty((0, 3))
