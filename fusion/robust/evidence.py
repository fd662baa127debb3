"""Tests whether measurements agree because of the pose or by chance."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch
from fusion.distance.rows import log_volumes
from fusion.solve.local import LocalSolution

POSE_VOLUME = 8.0 * math.pi**2  # of all rotations (as rotation vectors spread evenly), times one cubic metre


def log_evidence(b: Batch, used: NDArray[np.bool_], local: LocalSolution) -> float:
    """Return the natural log odds that the used measurements stem from one pose, against all N being outliers.

    An outlier is uniform within a metre and over direction cosines; an inlier is near its predicted value with its own
    covariance. Two penalties are subtracted: for the free parameters of the pose (posterior over prior volume,
    Laplace), and for the choice of this set among all sets of its size.

    Args:
        b: packed measurements.
        used: (N,) which agree.
        local: the solution from those.
    """
    n, k = len(b.cls), int(np.sum(used))
    volumes = np.zeros(n)
    log_volumes(b, local.rotation, local.translation_m, volumes)
    gains = -volumes[used] - 0.5 * local.values[used]
    spread = 0.5 * np.linalg.slogdet(2.0 * math.pi * local.covariance)[1]
    choices = math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)
    return float(gains.sum() + min(spread - math.log(POSE_VOLUME), 0.0) - choices)
