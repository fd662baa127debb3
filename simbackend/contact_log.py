"""The forces between the arm and everything that it touches, kept for the judge in blocks of a fraction of a second."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from hal.simulated import TrueContact

BLOCKS = 4500  # as many as states of the objects are kept: 15 minutes of contact in blocks of 0.2 s


@dataclass(slots=True, eq=False)
class _Block:
    """Sums and peaks of some ticks; `changes` counts the ticks with contact in this tick and in the one before."""

    peak_n: float = 0.0
    peaks_n: dict[int, float] = field(default_factory=dict)
    impulse_n_s: float = 0.0
    changes: int = 0
    squares_n2: float = 0.0


def contacts_of(contacts: Sequence[Any], arm: int) -> list[Any]:
    """Return the contact points of the arm, with the forces on the arm, from all contact points of the engine.

    The engine gives the forces on the first of two bodies. Asked for one body only, it puts that body first and turns the
    normals round, but not the friction, which then counts with the wrong sign: two forces of 127 N that kept each other in
    balance appeared as 236 N.
    """
    found = []
    for contact in contacts:
        if contact[1] == arm:
            found.append(contact)
        elif contact[2] == arm:
            found.append(_turned_round(contact))
    return found


def _turned_round(contact: Any) -> tuple[Any, ...]:
    """Return a contact point with its two bodies exchanged, and with that the directions of its forces."""
    flags, a, b, link_a, link_b, on_a, on_b, normal, gap_m, *forces = contact
    turned = [tuple(-x for x in one) if isinstance(one, tuple) else one for one in forces]
    return (flags, b, a, link_b, link_a, on_b, on_a, tuple(-x for x in normal), gap_m, *turned)


class ContactLog:
    """Peak, impulse and chatter of the contact force since any time that is kept.

    Args:
        bodies: the engine's number of each part of the panel, by name.
        dt_s: seconds in a tick.
    """

    def __init__(self, bodies: Mapping[str, int], dt_s: float) -> None:
        self._names = {number: name for name, number in bodies.items()}
        self._dt_s = dt_s
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.peak_n = 0.0
        self._last_n: float | None = None
        self._block = _Block()
        self._past: deque[tuple[int, _Block]] = deque(maxlen=BLOCKS)

    def nothing(self) -> None:
        """Note a tick without contact."""
        self._last_n = None

    def note(self, contacts: Sequence[Any]) -> None:
        """Note a tick's contact points of the arm, as the engine returns them."""
        forces: dict[int, list[float]] = {}
        for contact in contacts:
            total = forces.setdefault(contact[2], [0.0, 0.0, 0.0])
            for size, along in ((contact[9], contact[7]), (contact[10], contact[11]), (contact[12], contact[13])):
                for axis in range(3):
                    total[axis] += size * along[axis]
        block = self._block
        for body, force in forces.items():
            block.peaks_n[body] = max(block.peaks_n.get(body, 0.0), math.hypot(*force))
        now_n = math.hypot(*(sum(axis) for axis in zip(*forces.values(), strict=True)))
        block.peak_n = max(block.peak_n, now_n)
        block.impulse_n_s += now_n * self._dt_s
        if self._last_n is not None:
            block.changes += 1
            block.squares_n2 += (now_n - self._last_n) ** 2
        self._last_n = now_n
        self.peak_n = max(self.peak_n, now_n)

    def end_block(self, tick: int) -> None:
        """Keep the forces of the ticks up to this one, if there were any, and begin the next block."""
        if self._block.peaks_n:
            self._past.append((tick, self._block))
            self._block = _Block()

    def since(self, time_s: float) -> TrueContact:
        """Return the forces since a time, from the beginning of the block in which it lies."""
        blocks = [block for tick, block in self._past if tick * self._dt_s > time_s] + [self._block]
        peaks: dict[str, float] = {}
        for block in blocks:
            for body, peak_n in block.peaks_n.items():
                name = self._names.get(body, "_arm")
                peaks[name] = max(peaks.get(name, 0.0), peak_n)
        changes = sum(block.changes for block in blocks)
        return TrueContact(
            peak_n=max(block.peak_n for block in blocks),
            peaks_n=peaks,
            impulse_n_s=sum(block.impulse_n_s for block in blocks),
            chatter_n=math.sqrt(sum(block.squares_n2 for block in blocks) / changes) if changes else 0.0,
        )
