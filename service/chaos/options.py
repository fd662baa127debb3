"""The options of a run of chaos, and what one of its rounds did."""

from __future__ import annotations

from dataclasses import dataclass, field

from service.chaos.faults import FAULTS, ChaosFault


@dataclass(frozen=True, slots=True, kw_only=True)
class ChaosOptions:
    """Options of a run.

    Attributes:
        verb, body: the task during which things are broken.
        longest_s: the fault begins at a random time up to this long after the task has begun to run.
        faults: names of the faults to choose from; empty for all.
        rounds: number of rounds; None to go on until `minutes` have passed.
        patience: factor on the time that a fault lasts; 1 for real missions.
    """

    seed: int = 1
    minutes: float = 30.0
    rounds: int | None = None
    verb: str = "missions"
    body: dict[str, object] = field(default_factory=lambda: {"file": "demo"})
    longest_s: float = 12.0
    patience: float = 1.0
    faults: tuple[str, ...] = ()

    def chosen(self) -> tuple[ChaosFault, ...]:
        """Return the faults to choose from."""
        return tuple(fault for fault in FAULTS if not self.faults or fault.name in self.faults)


@dataclass(slots=True, kw_only=True)
class Round:
    """What one fault did.

    Attributes:
        what: which thing was broken.
        ended: state of the task, with the type of its problem.
        followed_s: from the fault until the stop was latched or the task had ended, where one of them must follow.
        back_s: from the end of the fault until the cell was ready.
        breaches: invariants that did not hold.
    """

    number: int
    fault: str
    what: str = ""
    ended: str = ""
    followed_s: float | None = None
    back_s: float | None = None
    breaches: list[str] = field(default_factory=list)
