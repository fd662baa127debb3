"""The entry point of fusion: computes a pose from measurements, some of which may be wrong (paper IV)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch, duplicates, pack
from fusion.measurement import Measurement
from fusion.robust.answer import FusedPose, Proofs, judged
from fusion.robust.inliers import MOST, too_many
from fusion.robust.minima import minima
from fusion.robust.with_shape import fuse_shape
from fusion.shapes import Shape
from fusion.solve.local import LocalSolution, local_solution
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose


def fuse(
    measurements: Sequence[Measurement],
    *,
    prior: UncertainPose | None = None,
    shape: Shape | None = None,
    certify: bool = False,
    prove_set_within_s: float | None = None,
    seed: int = 0,
) -> FusedPose:
    """Return the pose on which the largest part of the measurements agrees.

    Args:
        measurements: any mixture of the nine classes, in any order.
        prior: a prior pose (say from the four lights) with its covariance; it can be outvoted, and is then listed in
            `rejected` with index -1.
        shape: the object's family when its own dimensions (a radius, a size) are to be estimated too; measurements with a
            `part` follow it, and a prior pose is needed as a start.
        certify: also bound the error from below by a semidefinite relaxation (needs clarabel).
        prove_set_within_s: also prove which set of measurements is best, by branch and bound, for at most 16 of them;
            after so many seconds the remaining gap is stated instead.
        seed: of the random subsets; the same input and seed give the same result.

    Raises:
        InvalidRequest: a measurement is invalid (`details["index"]`, `details["reason"]`), there is none, there are too
            many for branch and bound, or a shape comes without a prior pose or with something to prove.
        Contradiction: no set of measurements agrees by more than chance; `details` names those outside the best set.
    """
    if not len(measurements) and prior is None:
        raise InvalidRequest("no measurement to fuse", hint="give at least one measurement or a prior pose")
    if shape is not None:
        if prior is None:
            raise InvalidRequest(
                "a measurement of a shape needs an initial pose", hint="give `prior`, for example from the camera"
            )
        if certify or prove_set_within_s is not None:
            raise InvalidRequest(
                "nothing can be proven of a shape whose dimensions are unknown",
                hint="leave out `certify` and `prove_set_within_s`",
            )
        return fuse_shape(measurements, shape, prior)
    repeats = duplicates(measurements)
    index = np.array([*range(len(measurements)), *([-1] if prior is not None else [])])
    b = pack(measurements, prior)
    if repeats:
        first = np.array([i not in repeats for i in index])
        index, b = index[first], b.part(first)
    proofs = Proofs(certificate=certify, set_within_s=prove_set_within_s)
    if prove_set_within_s is not None and len(b.cls) > MOST:
        raise too_many(len(b.cls))
    best, others = minima(b, np.random.default_rng(seed))
    return judged(b, best, others, index, measurements, repeats, proofs)


def used_entries(
    measurements: Sequence[Measurement], answer: FusedPose
) -> tuple[Batch, NDArray[np.bool_], LocalSolution]:
    """Return the packed measurements of a result, which of them it used (N,), and the local solution there.

    Raises:
        InvalidRequest: a measurement is invalid.
    """
    b = pack(measurements)
    used = np.ones(len(measurements), bool)
    used[[r.index for r in answer.rejected if r.index >= 0]] = False
    R, t = answer.pose.rotation.as_matrix(), np.array(answer.pose.translation)
    return b, used, local_solution(b, used.astype(float), R, t, far=False)
