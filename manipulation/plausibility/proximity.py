"""Compares proximity sensors with the plate that the fingers touched at the same place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import ProximityCapabilities
from hal.panel import Panel
from manipulation.planning.touch_points import room_m
from manipulation.plausibility.finding import Finding, Symptom

BARE_M = 0.010  # radius of free plate around the beam's foot, so that no part of the beam sees an edge
LEAST_OFF_M = 0.005  # mounts and plates are known better than this
OFF_SIGMA = 6.0  # standard deviations of one reading


class ProximityMonitor:
    """Finds a sensor whose readings over the touched plate are off by the same amount at two places in a row.

    A single place is not sufficient, because a cable may hang in front of the plate there.
    """

    def __init__(self, panel: Panel) -> None:
        self._panel = panel
        self._off_before_m: dict[str, Array] = {}

    def note(
        self,
        sensor: str,
        of: ProximityCapabilities,
        readings: Sequence[tuple[RigidTransform, float]],
        *,
        base_from_panel: RigidTransform,
        touched_m: Array,
    ) -> Finding | None:
        """Check one place of the plate; there is a finding if the sensor is off there as at the place before.

        Args:
            of: range and noise of the sensor.
            readings: `base_from_sensor` and the distance measured from there, m; NaN where nothing was seen.
            touched_m: (3,) where the fingers met the plate, base frame.
        """
        expected_m: list[float] = []
        for place, _ in readings:
            distance_m = self._expected_m(of, place, base_from_panel, touched_m)
            if distance_m is None:
                return None
            expected_m.append(distance_m)
        said_m = np.array([distance_m for _, distance_m in readings])
        off_m = said_m - np.array(expected_m)
        limit_m = max(LEAST_OFF_M, OFF_SIGMA * of.sigma_m)
        if np.all(np.abs(off_m) <= limit_m):  # false for NaN
            self._off_before_m.pop(sensor, None)
            return None
        before_m, self._off_before_m[sensor] = self._off_before_m.get(sensor), off_m
        if before_m is None or not np.allclose(before_m, off_m, rtol=0.0, atol=limit_m, equal_nan=True):
            return None
        worst = int(np.argmax(np.nan_to_num(np.abs(off_m), nan=np.inf)))
        says = "sees nothing" if np.isnan(said_m[worst]) else f"says {1e3 * said_m[worst]:.0f} mm"
        return Finding(
            device=sensor,
            symptom=Symptom.BIASED,
            what=f"{sensor} {says} where the plate, as the fingers touched it, is {1e3 * expected_m[worst]:.0f} mm away,"
            " and was as wrong at the place before: it is frozen, off its zero or out of line",
            remedy="clean its window, check its mount and cable, switch it off and on, then send this again",
        )

    def _expected_m(
        self,
        of: ProximityCapabilities,
        base_from_sensor: RigidTransform,
        base_from_panel: RigidTransform,
        touched_m: Array,
    ) -> float | None:
        """Return the distance of the free plate along the beam, m; None where the beam may meet something else."""
        panel_from_sensor = base_from_panel.inv() * base_from_sensor
        start, beam = panel_from_sensor.translation, panel_from_sensor.rotation.apply([0.0, 0.0, 1.0])
        if beam[2] > -0.9:
            return None
        level_m = float(base_from_panel.inv().apply(touched_m)[2])
        distance_m = float((level_m - start[2]) / beam[2])
        foot = (start + distance_m * beam)[:2]
        is_seen = of.min_range_m + LEAST_OFF_M < distance_m < of.max_range_m - LEAST_OFF_M
        edge_m = float(np.min(0.5 * np.array([self._panel.width_m, self._panel.height_m]) - np.abs(foot)))
        is_bare = min(edge_m, float(room_m(self._panel, foot[None])[0])) >= BARE_M
        return distance_m if is_seen and is_bare else None
