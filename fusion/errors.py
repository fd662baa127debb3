"""Errors of fusion."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

from hal.errors import Ambiguous


class Contradiction(Ambiguous):
    """The measurements contradict each other, and no part of them agrees by more than chance."""

    @classmethod
    def among(cls, agreeing: int, total: int, outside: Sequence[tuple[int, str, float]]) -> Self:
        """Return the error when `agreeing` of `total` agree; `outside` lists (index, label, value) of the rest."""
        return cls(
            f"only {agreeing} of {total} measurements agree, which chance explains",
            hint="check which feature was sensed where, and the units; or add measurements",
            agreeing=agreeing,
            total=total,
            outside=[{"index": i, "label": label, "value": round(value, 3)} for i, label, value in outside],
        )
