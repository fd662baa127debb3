"""Taught knowledge about kinds of objects (files: `knowledge_files`).

A kind has a size and looks. A look is the feature vector of one taught example (see `look`): four rows of numbers
over the distance from the middle, and two tables with one row per direction. The kind `nothing` has looks of what
is *not* an object: screws, labels, parts of objects. Adding a look to one kind changes no other kind's looks.

Some looks were taught from noisy images, as a camera takes them in bad light. Only noisy images are compared with them,
because in a good image other objects would resemble these blurred, half shaded examples.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from perception.vision.look import NOISY_WEIGHTS, WEIGHTS

NOTHING = "nothing"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtKind:
    """A kind of object.

    Attributes:
        name: as in the panel file if it has a reader, else free.
        size_m: (width, height) of a typical object, m.
        looks: (N, LENGTH), one row per example.
        taught_by: a remark about the origin of the examples.
        middles_m: (N, 2) offset from the place with that look to the object's middle, x right, y up; None if all are
        zero.
        noisy: (N,) which looks count in noisy images only; None if none do.
        reach_m: (N,) distance from the middle beyond which the numbers of a look do not count, because other things are
        there; infinite if all count, and None if they do in every look.
    """

    name: str
    size_m: tuple[float, float]
    looks: Array
    taught_by: str = ""
    middles_m: Array | None = None
    noisy: NDArray[np.bool_] | None = None
    reach_m: Array | None = None

    @property
    def lasting(self) -> TaughtKind:
        """The kind with only those looks that count in every image."""
        return self if self.noisy is None else replace(self.of(~self.noisy), noisy=None)

    def of(self, rows: NDArray[Any]) -> TaughtKind:
        """Return the kind with only the given rows of its looks."""
        middles_m, noisy, reach_m = (
            None if one is None else one[rows] for one in (self.middles_m, self.noisy, self.reach_m)
        )
        return replace(self, looks=self.looks[rows], middles_m=middles_m, noisy=noisy, reach_m=reach_m)

    def joined(self, other: TaughtKind) -> TaughtKind:
        """Return the kind with another one's looks appended to its own."""
        counts = len(self.looks), len(other.looks)
        middles_m = _joined(self.middles_m, other.middles_m, *(np.zeros((n, 2)) for n in counts))
        noisy = _joined(self.noisy, other.noisy, *(np.zeros(n, bool) for n in counts))
        reach_m = _joined(self.reach_m, other.reach_m, *(np.full(n, np.inf) for n in counts))
        looks = np.vstack([self.looks, other.looks])
        return replace(self, looks=looks, middles_m=middles_m, noisy=noisy, reach_m=reach_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Knowledge:
    """All kinds, and the measure of similarity to them.

    Attributes:
        spread: (LENGTH,) how much every number varies between all examples, the unit of similarity.
        weights: (LENGTH,) of the numbers.
    """

    kinds: tuple[TaughtKind, ...]
    spread: Array
    weights: Array = field(default_factory=lambda: WEIGHTS)

    def for_image(self, *, noisy: bool) -> Knowledge:
        """Return the knowledge with which an image is compared.

        For a noisy image these are all looks, without numbers far from the middle; else only the looks that count in
        every image.
        """
        return _for_image(self, noisy=noisy)

    def kind(self, name: str) -> TaughtKind | None:
        """Return the kind with that name, or None."""
        return next((kind for kind in self.kinds if kind.name == name), None)

    def grown(self, more: TaughtKind) -> Knowledge:
        """Return the knowledge with further looks of a kind, which may be new."""
        known = self.kind(more.name)
        if known is None:
            return replace(self, kinds=(*self.kinds, more))
        return replace(self, kinds=tuple(kind.joined(more) if kind is known else kind for kind in self.kinds))

    def with_looks_of(self, kinds: Iterable[TaughtKind]) -> Knowledge:
        """Return the knowledge with the looks of these kinds added.

        Looks that are already known are not added again.
        """
        grown = self
        for kind in kinds:
            known = grown.kind(kind.name)
            seen = set() if known is None else {look.tobytes() for look in known.looks}
            grown = grown.grown(kind.of(np.array([look.tobytes() not in seen for look in kind.looks])))
        return grown


def _joined(
    one: NDArray[Any] | None, other: NDArray[Any] | None, plain: NDArray[Any], plain_of_other: NDArray[Any]
) -> NDArray[Any] | None:
    """Return the rows of two kinds as one array, with plain rows for what is None; None if both are."""
    if one is None and other is None:
        return None
    return np.concatenate([plain if one is None else one, plain_of_other if other is None else other])


@lru_cache(maxsize=8)
def _for_image(knowledge: Knowledge, *, noisy: bool) -> Knowledge:
    """Compute `Knowledge.for_image`; equal arguments give the same object, so that `prepared` can cache by identity."""
    if noisy:
        return replace(knowledge, weights=NOISY_WEIGHTS)
    kinds = (kind.lasting for kind in knowledge.kinds)
    return replace(knowledge, kinds=tuple(kind for kind in kinds if len(kind.looks)), weights=WEIGHTS)


def spread_of(kinds: Iterable[TaughtKind]) -> Array:
    """Return the standard deviation (LENGTH,) of every number over the looks of all kinds but `nothing`.

    Only looks that count in every image are used, and each kind has the same weight.
    """
    lasting = (kind.lasting for kind in kinds if kind.name != NOTHING)
    kinds = [kind for kind in lasting if len(kind.looks)]
    means = np.array([kind.looks.mean(axis=0) for kind in kinds])
    within = np.array([kind.looks.var(axis=0) for kind in kinds]).mean(axis=0)
    return np.asarray(np.maximum(np.sqrt(within + means.var(axis=0)), 0.05))
