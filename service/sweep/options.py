"""What all panels of a sweep share."""

from __future__ import annotations

from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path

from hal.errors import InvalidRequest
from service.sweep.deeds import ROWS, Deed
from service.sweep.draw import NOMINAL


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """Options of a sweep.

    Attributes:
        cell: cell file that gives arm, sensors and workspace.
        only: kinds or rows to which the deeds are limited; empty for all.
        known_pose: whether the panel's pose is given, with the error that the border lights leave, instead of looked for.
        mission: whether all deeds are ordered in one mission, instead of one after the other.
        inline: whether the cell is in this process, which starts faster; the answers are the same.
    """

    cell: Path
    only: tuple[str, ...] = ()
    known_pose: bool = False
    inline: bool = False
    mission: bool = False

    def wants(self, deed: Deed) -> bool:
        """Return whether the sweep is about this deed."""
        return not self.only or deed.kind in self.only or deed.row in self.only


def chosen(text: str) -> tuple[str, ...]:
    """Return the kinds and rows in a list with commas.

    Raises:
        InvalidRequest: there is no such kind or row.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    known = (*NOMINAL, *ROWS)
    if wrong := [name for name in names if name not in known]:
        near = get_close_matches(wrong[0], known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise InvalidRequest(f"a sweep has no control {wrong[0]!r}", hint=hint)
    return names
