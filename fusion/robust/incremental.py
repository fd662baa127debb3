"""One measurement more, or one less, without starting over.

The new pose is a local solve from the old one. Only when that changes which measurements are believed does the whole search
run again, because then another pose may have become the best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.batch import Batch, duplicates, pack
from fusion.measurement import Measurement
from fusion.robust.answer import FusedPose, Proofs, judged
from fusion.robust.minima import Minimum, finished, minima
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fusion:
    """Measurements fused so far.

    Attributes:
        measurements: all of them, in the order they came.
        answer: as `fusion.robust.fuse` gives it.
        batch, best, others: what the next step starts from.
        prior: the pose believed beforehand, if any.
    """

    measurements: tuple[Measurement, ...]
    answer: FusedPose
    batch: Batch
    best: Minimum
    others: tuple[Minimum, ...]
    prior: UncertainPose | None


def start(measurements: Sequence[Measurement], *, prior: UncertainPose | None = None, seed: int = 0) -> Fusion:
    """Fuse a first set from scratch.

    Raises:
        InvalidRequest: a measurement makes no sense, repeats another, or there is none.
        Contradiction: the measurements agree no better than by chance.
    """
    if not len(measurements) and prior is None:
        raise InvalidRequest("no measurement to fuse", hint="give at least one measurement or a prior pose")
    for i, first in duplicates(measurements).items():
        raise InvalidRequest(
            f"measurement {i} repeats measurement {first}",
            hint="give each measurement once",
            index=i,
            reason="duplicate",
        )
    return _searched(tuple(measurements), pack(measurements, prior), prior, seed)


def add(fusion: Fusion, measurement: Measurement) -> Fusion:
    """The fusion with one measurement more.

    Raises:
        InvalidRequest: the measurement makes no sense, or was given before.
        Contradiction: as `start`.
    """
    given = (*fusion.measurements, measurement)
    if len(given) - 1 in duplicates(given):
        i = len(given) - 1
        raise InvalidRequest(f"measurement {i} was given before", hint="add each once", index=i, reason="duplicate")
    one, old = pack([measurement]), fusion.batch
    last = len(fusion.measurements)  # a prior stays at the end
    rows = {
        name: np.insert(getattr(old, name), last, getattr(one, name)[0], axis=0)
        for name in old._fields
        if not name.startswith("prior")
    }
    believed = np.insert(fusion.best.used, last, True)
    return _stepped(fusion, given, old._replace(**rows), believed)


def remove(fusion: Fusion, index: int) -> Fusion:
    """The fusion without the measurement at `index`.

    Raises:
        InvalidRequest: no such measurement, or it is the last one.
        Contradiction: as `start`.
    """
    count = len(fusion.measurements)
    if not 0 <= index < count or len(fusion.batch.cls) == 1:
        raise InvalidRequest(f"cannot remove measurement {index} of {count}", hint="give an index of one of several")
    given = tuple(m for i, m in enumerate(fusion.measurements) if i != index)
    keep = np.arange(len(fusion.batch.cls)) != index
    return _stepped(fusion, given, fusion.batch.part(keep), fusion.best.used[keep])


def _stepped(fusion: Fusion, given: tuple[Measurement, ...], b: Batch, believed: NDArray[np.bool_]) -> Fusion:
    old = fusion.best.local
    best = finished(b, old.rotation, old.translation_m)
    if old.unobservable or not np.array_equal(best.used, believed):
        return _searched(given, b, fusion.prior, 0)
    others = (finished(b, m.local.rotation, m.local.translation_m) for m in fusion.others)
    kept = tuple(m for m in others if best.near(m))
    if any(m.cost < best.cost for m in kept):
        return _searched(given, b, fusion.prior, 0)
    return _made(given, b, best, kept, fusion.prior)


def _searched(given: tuple[Measurement, ...], b: Batch, prior: UncertainPose | None, seed: int) -> Fusion:
    best, others = minima(b, np.random.default_rng(seed))
    return _made(given, b, best, tuple(others), prior)


def _made(
    given: tuple[Measurement, ...], b: Batch, best: Minimum, others: tuple[Minimum, ...], prior: UncertainPose | None
) -> Fusion:
    index = np.array([*range(len(given)), *([-1] if prior is not None else [])])
    answer = judged(b, best, others, index, given, {}, Proofs())
    return Fusion(measurements=given, answer=answer, batch=b, best=best, others=others, prior=prior)
