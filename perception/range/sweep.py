"""Depth image from a line scanner that the arm sweeps: each beam is placed with the scanner's pose at its own time.

base_point = base_from_scanner(t) r (sin a, 0, cos a),   t = end of scan - |last beam's angle - a| T / (2 pi)

r is the range of a beam, a its angle in the scan plane, and T the period of the scanner's rotation. Two passes in opposite
directions show by how much the time stamps are late: a delay turns the scene of each pass the way of its motion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

from hal.arrays import Array
from hal.devices import RangeImage, RangeScannerCapabilities
from hal.errors import InvalidRequest, NotFound, StaleReading
from hal.geometry import UncertainPose, matrix_of
from hal.readings import Quality, Stamped
from perception.range.from_points import image_from_points
from perception.range.sensor import PinholeSensor

LONGEST_GAP_S = 0.1  # between two poses; at 1 m/s^2 the path deviates at most 1.3 mm from a straight line in this time
DELAY_STEP_S, DELAY_ROUNDS = 0.02, 3  # over a shorter step the noise of the depths would count
STAMP_SIGMA_S = 5e-4  # of the mean stamp of one pass; single stamps of the drivers are 0.1 to 1.3 ms wrong at p99
MOST_DELAY_S = 0.1  # older data are left out by the drivers
OUTLIER = 5.0  # median deviations


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweepPass:
    """The scans of one motion over all lines, and the poses of the scanner during it.

    Attributes:
        scans: with the stamps of the scanner's driver.
        times_s: increasing times on the cell's clock.
        base_from_scanner: the pose at each of them.
    """

    scans: Sequence[Stamped[RangeImage]]
    times_s: Sequence[float]
    base_from_scanner: Sequence[RigidTransform]

    def in_base(self, in_scanner_m: Array, times_s: Array) -> Array:
        """Return points (n, 3) in the base frame, metres, each with the scanner's pose at its own time.

        Between two known poses the translation is interpolated linearly, and the rotation about a fixed axis.

        Raises:
            StaleReading: a time lies outside the known poses or in a gap of them.
        """
        known_s = np.asarray(self.times_s, np.float64)
        if len(known_s) < 2 or times_s.min() < known_s[0] or times_s.max() > known_s[-1]:
            raise StaleReading("no arm pose from the time of the scan", hint="record poses before and after the sweep")
        after = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
        longest_s = float((known_s[after] - known_s[after - 1]).max())
        if longest_s > LONGEST_GAP_S:
            gap = f"{longest_s:.2f} s"
            raise StaleReading(f"arm poses have a gap of {gap} at the time of the scan", hint="read the arm more often")
        known_m = np.stack([pose.translation for pose in self.base_from_scanner])
        shift_m = np.stack([np.interp(times_s, known_s, axis_m) for axis_m in known_m.T], axis=1)
        turns = Slerp(known_s, Rotation.concatenate([pose.rotation for pose in self.base_from_scanner]))
        return np.asarray(turns(times_s).apply(in_scanner_m) + shift_m)

    def covered(self, c: RangeScannerCapabilities, delay_s: float = 0.0) -> list[Stamped[RangeImage]]:
        """Return the scans with a known pose for every beam, with stamps that are not late any more."""
        if not self.times_s:
            return []
        moved = [replace(scan, host_time_s=scan.host_time_s - delay_s) for scan in self.scans]
        first_s, last_s = self.times_s[0], self.times_s[-1]
        return [s for s in moved if first_s <= beam_times_s(s.host_time_s, c)[0] and s.host_time_s <= last_s]

    def points(self, c: RangeScannerCapabilities, delay_s: float) -> Array:
        """Return the points (n, 3) of all covered scans in the base frame, metres."""
        beams = [_beams(scan, c) for scan in self.covered(c, delay_s)]
        if not sum(len(times_s) for _, times_s in beams):
            return np.empty((0, 3))
        return self.in_base(np.concatenate([b[0] for b in beams]), np.concatenate([b[1] for b in beams]))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweptErrors:
    """Errors of the image of a sweep that a range camera's image does not have.

    With the error (d, r) of the mount a range camera sees each point X shifted by d + r x X. In a sweep the error turns
    with the scanner, by the angle a about its x axis at which X was seen, so there is, to first order, in addition

    (R(a) - 1) d + ((R(a) - 1) r) x X,   a = atan2(-y, z)

    Two passes the same way round share neither the errors of the arm's path nor those of the time stamps, and their
    difference shows how large those are. The delay that both have in common is taken out, but not the difference of the
    two delays, which turns the image about the x axis.

    Attributes:
        covariance: (6, 6) of (d, r), m and rad, in the axes of the scanner as it stood before the sweep.
        apart_m: (H, W) difference of the depths by the two passes, NaN where not both measured; None with one pass.
        sigma_turn_rad: of the angle about the x axis by which the time stamps turn the image.
        sigma_range_m: of an error that all distances have in common.
    """

    covariance: Array
    apart_m: Array | None = None
    sigma_turn_rad: float = 0.0
    sigma_range_m: float = 0.0

    @classmethod
    def of(
        cls,
        mount: UncertainPose,
        *,
        apart_m: Array | None = None,
        rate_rad_per_s: float = 0.0,
        sigma_range_m: float = 0.0,
    ) -> SweptErrors:
        """Return it for a mount, whose covariance is in the axes of the flange, and the speed of the sweep."""
        turn = np.kron(np.eye(2), matrix_of(mount.parent_from_child).T)
        return cls(
            covariance=turn @ mount.covariance @ turn.T,
            apart_m=apart_m,
            sigma_turn_rad=rate_rad_per_s * STAMP_SIGMA_S / math.sqrt(2.0),
            sigma_range_m=sigma_range_m,
        )

    def distances(self, points_m: Array, normal: Array) -> Array:
        """Return by how much points (N, 3) move along `normal` (3,), per unit of the error (N, 6)."""
        turned = Rotation.from_rotvec(np.outer(np.arctan2(-points_m[:, 1], points_m[:, 2]), [1.0, 0.0, 0.0]))
        back = turned.inv()
        across = np.cross(points_m, normal)
        return np.hstack([back.apply(normal) - normal, back.apply(across) - across])

    def farther(self, points_m: Array, normal: Array) -> Array:
        """Return by how much points (N, 3) move along `normal` (3,), per unit of an error of all distances."""
        return np.asarray(points_m @ normal / np.linalg.norm(points_m, axis=1))

    def turned(self, points_m: Array, normal: Array) -> Array:
        """Return by how much points (N, 3) move along `normal` (3,), per radian about the x axis."""
        return np.asarray(np.cross([1.0, 0.0, 0.0], points_m) @ normal)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ImageOfSweep:
    """Depth (H, W) in metres, NaN where nothing was measured; its geometry; `apart_m` as in `SweptErrors`."""

    depth_m: Array
    view: PinholeSensor
    apart_m: Array | None


def image_from_sweep(
    passes: Sequence[SweepPass],
    capabilities: RangeScannerCapabilities,
    *,
    base_from_view: RigidTransform,
    half_height_rad: float,
    swept_rad: float,
) -> ImageOfSweep:
    """Return the image that a range camera at `base_from_view` would have taken.

    A pixel is as wide as the step between two beams in the middle of the image, and as high as the rotation between two
    scans of one pass. With two passes the delay of the time stamps is estimated and taken out.

    Args:
        base_from_view: a pose of the scanner within the sweep.
        half_height_rad: the image reaches by this angle to both sides of it.
        swept_rad: angle that was swept about the scanner's x axis.

    Raises:
        InvalidRequest: the scans are not those of a line scanner.
        NotFound: no point falls into the view.
        StaleReading: the known poses have a gap.
    """
    c = capabilities
    step_rad = max(abs(c.step_angle_rad), 1e-4)
    half_width_rad = min(0.5 * (c.width - 1) * step_rad, half_height_rad)
    lines = max(len(one.covered(c)) for one in passes)
    line_rad = max(swept_rad / max(lines, 1), step_rad)
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
    delay_s = delay_between(passes[0], passes[1], c, base_from_view, view) if len(passes) == 2 else 0.0
    points = [one.points(c, delay_s) for one in passes]
    images = [image_from_points(some, base_from_view, view) for some in points] if len(passes) == 2 else []
    return ImageOfSweep(
        depth_m=image_from_points(np.concatenate(points), base_from_view, view),
        view=view,
        apart_m=np.subtract(*images) if images else None,
    )


def delay_between(
    first: SweepPass,
    second: SweepPass,
    c: RangeScannerCapabilities,
    base_from_view: RigidTransform,
    view: PinholeSensor,
) -> float:
    """Return by how many seconds the stamps are late, from two passes in opposite directions.

    It is the delay at which both passes see the same depths, by Gauss-Newton over the pixels that both see; pixels at
    jumps of the depth do not count. Zero if the scene does not show it.
    """

    def apart_m(delay_s: float) -> Array:
        try:
            return np.subtract(
                *(image_from_points(p.points(c, delay_s), base_from_view, view) for p in (first, second))
            )
        except NotFound:
            return np.full((view.height_px, view.width_px), np.nan)

    per_s = (apart_m(DELAY_STEP_S) - apart_m(-DELAY_STEP_S)) / (2.0 * DELAY_STEP_S)
    delay_s = 0.0
    for _ in range(DELAY_ROUNDS):
        apart = apart_m(delay_s)
        known = np.isfinite(apart) & np.isfinite(per_s)
        if not known.any():
            return 0.0
        middle_m = np.median(apart[known])
        known &= np.abs(np.nan_to_num(apart) - middle_m) <= OUTLIER * np.median(np.abs(apart[known] - middle_m)) + 1e-9
        slope = per_s[known]
        if not slope @ slope > 0.0:
            return 0.0
        delay_s -= float(slope @ apart[known] / (slope @ slope))
        delay_s = min(max(delay_s, -MOST_DELAY_S), MOST_DELAY_S)
    return delay_s


def beam_times_s(end_s: float, c: RangeScannerCapabilities) -> Array:
    """Return the time at which each beam was measured: the scanner rotates steadily, and the last beam ends the scan.

    Args:
        end_s: time stamp of the scan, as the drivers of line scanners give it.
    """
    before_s = (c.width - 1 - np.arange(c.width)) * abs(c.step_angle_rad) / (math.tau * c.rate_hz)
    return np.asarray(end_s - before_s, np.float64)


def _beams(scan: Stamped[RangeImage], c: RangeScannerCapabilities) -> tuple[Array, Array]:
    """Return the points (n, 3) of one scan in the scanner's frame, metres, and the time of each."""
    if not c.needs_sweep:
        raise InvalidRequest("only lines are swept", hint="a range camera's images need no sweep")
    range_m = scan.value.depth_m[0].astype(np.float64)
    seen = np.isfinite(range_m) & (scan.quality is not Quality.INVALID)
    angle_rad = c.first_angle_rad + np.arange(c.width) * c.step_angle_rad
    in_scanner_m = range_m[:, np.newaxis] * np.stack([np.sin(angle_rad), 0.0 * angle_rad, np.cos(angle_rad)], axis=1)
    return in_scanner_m[seen], beam_times_s(scan.host_time_s, c)[seen]
