"""Depth image from a line scanner that the arm sweeps: each beam is placed with the scanner's pose at its own time.

base_point = base_from_scanner(t) r (sin a, 0, cos a),   t = end of scan - |last beam's angle - a| T / (2 pi)

r is the range of a beam, a its angle in the scan plane, and T the period of the scanner's rotation.
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
from perception.range.from_points import image_from_points
from perception.range.sensor import PinholeSensor

LONGEST_GAP_S = 0.1  # between two poses; at 1 m/s^2 the path deviates at most 1.3 mm from a straight line in this time
KNOTS = 9  # poses per scan; the poses of beams between two of them are interpolated


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ScannerTrack:
    """Poses of the scanner during a sweep.

    Attributes:
        times_s: increasing times on the cell's clock.
        base_from_scanner: the pose at each of them.
    """

    times_s: Sequence[float]
    base_from_scanner: Sequence[RigidTransform]

    def at(self, time_s: float) -> RigidTransform:
        """Return the pose at a time between two known ones, interpolated.

        Raises:
            StaleReading: the time lies outside the track or in a gap of it.
        """
        after = bisect_left(self.times_s, time_s)
        if after < len(self.times_s) and self.times_s[after] == time_s:
            return self.base_from_scanner[after]
        if not 0 < after < len(self.times_s):
            raise StaleReading("no arm pose from the time of the scan", hint="record poses before and after the sweep")
        start_s, end_s = self.times_s[after - 1], self.times_s[after]
        if end_s - start_s > LONGEST_GAP_S:
            gap = f"{end_s - start_s:.2f} s"
            raise StaleReading(f"arm poses have a gap of {gap} at the time of the scan", hint="read the arm more often")
        fraction = (time_s - start_s) / (end_s - start_s)
        return interpolate(self.base_from_scanner[after - 1], self.base_from_scanner[after], fraction)

    def covers(self, start_s: float, end_s: float) -> bool:
        """Return whether poses are known from `start_s` or before until `end_s` or after."""
        return bool(len(self.times_s)) and self.times_s[0] <= start_s and end_s <= self.times_s[-1]


def image_from_sweep(
    scans: Iterable[Stamped[RangeImage]],
    capabilities: RangeScannerCapabilities,
    *,
    times_s: Sequence[float],
    base_from_scanner: Sequence[RigidTransform],
    base_from_view: RigidTransform,
    half_height_rad: float,
) -> tuple[Array, PinholeSensor]:
    """Return depth (H, W) in metres and geometry of the image that a range camera at `base_from_view` would have taken.

    Only scans with a known pose for every beam are used. A pixel is as wide as the step between two beams in the middle
    of the image, and as high as the rotation between two scans.

    Args:
        times_s: increasing times on the cell's clock at which the scanner's pose is known.
        base_from_scanner: the pose at each of them.
        base_from_view: usually the scanner's pose half way through the sweep.
        half_height_rad: half of the angle that was swept about the scanner's x axis.

    Raises:
        InvalidRequest: the scans are not those of a line scanner.
        NotFound: no point falls into the view.
        StaleReading: the known poses have a gap.
    """
    track = ScannerTrack(times_s=times_s, base_from_scanner=base_from_scanner)
    c = capabilities
    covered = [s for s in scans if track.covers(float(beam_times_s(s.host_time_s, c)[0]), s.host_time_s)]
    parts = [scan_points(scan, c, track) for scan in covered]
    points = np.concatenate(parts) if parts else np.empty((0, 3))
    step_rad = max(abs(c.step_angle_rad), 1e-4)
    half_width_rad = min(0.5 * (c.width - 1) * step_rad, half_height_rad)
    line_rad = max(2.0 * half_height_rad / max(len(covered), 1), step_rad)
    width = 2 * max(2, round(math.tan(half_width_rad) / step_rad))
    height = 2 * max(2, round(math.tan(half_height_rad) / line_rad))
    view = PinholeSensor(
        width_px=width,
        height_px=height,
        fx_px=1.0 / step_rad,
        fy_px=1.0 / line_rad,
        cx_px=(width - 1) / 2.0,
        cy_px=(height - 1) / 2.0,
    )
    return image_from_points(points, base_from_view, view), view


def beam_times_s(end_s: float, c: RangeScannerCapabilities) -> Array:
    """Return the time at which each beam was measured: the scanner rotates steadily, and the last beam ends the scan.

    Args:
        end_s: time stamp of the scan, as the drivers of line scanners give it.
    """
    before_s = (c.width - 1 - np.arange(c.width)) * abs(c.step_angle_rad) / (math.tau * c.rate_hz)
    return np.asarray(end_s - before_s, np.float64)


def scan_points(scan: Stamped[RangeImage], c: RangeScannerCapabilities, track: ScannerTrack) -> Array:
    """Return the points (n, 3) of one scan in the base frame, metres, without beams that measured nothing.

    Raises:
        InvalidRequest: the scan is not that of a line scanner.
        StaleReading: the track does not cover the scan.
    """
    if not c.needs_sweep:
        raise InvalidRequest("only lines are swept", hint="a range camera's images need no sweep")
    range_m = scan.value.depth_m[0].astype(np.float64)
    seen = np.isfinite(range_m)
    if scan.quality is Quality.INVALID or not np.any(seen):
        return np.empty((0, 3))
    angle_rad = c.first_angle_rad + np.arange(c.width) * c.step_angle_rad
    in_scanner = range_m[:, np.newaxis] * np.stack([np.sin(angle_rad), 0.0 * angle_rad, np.cos(angle_rad)], axis=1)
    return _in_base(in_scanner[seen], beam_times_s(scan.host_time_s, c)[seen], track)


def _in_base(in_scanner: Array, times_s: Array, track: ScannerTrack) -> Array:
    """Transform points (n, 3) to the base frame, each with the scanner's pose at its own time.

    Between knots the translation is interpolated linearly, and the rotation about a fixed axis.
    """
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
    return np.asarray(turn.apply(in_scanner) + translation_m)
