"""Takes the readings of one task to everything that keeps them, before the task reports them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Protocol

from hal.priorities import promptly
from service.history.reading import StoredReading, answer_of
from service.history.store import History

if TYPE_CHECKING:
    from perception.vision import ObjectReading


Surroundings = Callable[[str], bytes | None]


def nothing_around(_name: str) -> bytes | None:
    """Return None: no surroundings are known."""
    return None


class Observer(Protocol):
    """What an operation tells about the objects that it reads and operates."""

    def saw(
        self,
        readings: Iterable[ObjectReading],
        crops: Mapping[str, bytes],
        surroundings: Surroundings = nothing_around,
        *,
        mission: str = "",
        phase: str = "",
    ) -> None:
        """Keep the readings; they are durable when this returns, and may be reported.

        Args:
            crops: PNG picture of each object, by its name.
            surroundings: returns a PNG picture of an object and the plate around it; asked for doubted readings only.
            mission: name of the mission's report.
            phase: part of the work, such as `before the actions`.

        Raises:
            HistoryError: they could not be stored.
        """
        ...

    def told(self, name: str, target: str) -> None:
        """Note what an object is now told to be."""
        ...

    @property
    def asked_by(self) -> str:
        """The key, else the holder of the lease, that asked for the task; empty without both."""
        ...

    def now_s(self) -> float:
        """Return the time by which readings are stamped, seconds since 1970."""
        ...

    def newest(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the fields of the newest reading of each object, by its name."""
        ...

    def alarms(self) -> Sequence[dict[str, str]]:
        """Return the alarms whose condition holds: `object`, `kind`, `says`, `priority` and `what_to_do`."""
        ...


class NoObserver:
    """Keeps nothing, for operations outside of a service."""

    def saw(
        self,
        readings: Iterable[ObjectReading],
        crops: Mapping[str, bytes],
        surroundings: Surroundings = nothing_around,
        *,
        mission: str = "",
        phase: str = "",
    ) -> None:
        """Drop the readings."""

    def told(self, name: str, target: str) -> None:
        """Drop the target."""

    @property
    def asked_by(self) -> str:
        """Nobody is known."""
        return ""

    def now_s(self) -> float:
        """The time of the machine."""
        return time.time()

    def newest(self) -> Mapping[str, Mapping[str, Any]]:
        """Nothing is known."""
        return {}

    def alarms(self) -> Sequence[dict[str, str]]:
        """There are none."""
        return ()


@dataclass(slots=True, kw_only=True, eq=False)
class Observations:
    """The history of a cell with those that listen to it.

    Attributes:
        listeners: called with readings after they were stored, for example to raise alarms.
        doubt_of: returns why a person should look at a reading; empty for one that is sure.
        certify: returns what judged cases say about a reading with this picture, as JSON; None: nothing is said.
        alarms: returns the alarms whose condition holds.
        now_s: seconds since 1970.
        targets: what each object was last told to be.
    """

    history: History
    listeners: list[Callable[[Sequence[StoredReading]], None]] = field(default_factory=list)
    doubt_of: Callable[[StoredReading], str] = lambda _reading: ""
    certify: Callable[[StoredReading, bytes | None], str | None] = lambda _reading, _crop: None
    alarms: Callable[[], Sequence[dict[str, str]]] = tuple
    now_s: Callable[[], float] = time.time
    targets: dict[str, str] = field(init=False)

    def __post_init__(self) -> None:
        self.targets = self.history.told()

    def keep(self, readings: Sequence[StoredReading]) -> None:
        """Store readings, then let the listeners see them.

        Raises:
            HistoryError: they could not be stored.
        """
        with promptly():
            self.history.add(readings)
            for listen in self.listeners:
                listen(readings)

    def of_task(self, *, task: str, verb: str, asked_by: str, cell_now_s: Callable[[], float]) -> TaskObserver:
        """Return the observer of one task."""
        return TaskObserver(self, task=task, verb=verb, asked_by=asked_by, cell_now_s=cell_now_s)


class TaskObserver:
    """Stores the readings of one task with its circumstances; see `Observer`."""

    def __init__(
        self, kept: Observations, *, task: str, verb: str, asked_by: str, cell_now_s: Callable[[], float]
    ) -> None:
        self._kept = kept
        self._by: dict[str, Any] = {"task": task, "verb": verb, "asked_by": asked_by}
        self._cell_now_s = cell_now_s

    def saw(
        self,
        readings: Iterable[ObjectReading],
        crops: Mapping[str, bytes],
        surroundings: Surroundings = nothing_around,
        *,
        mission: str = "",
        phase: str = "",
    ) -> None:
        """Store the readings, then let the listeners see them; see `Observer.saw`."""
        utc_s, cell_s = self._kept.now_s(), self._cell_now_s()
        stored = [
            StoredReading(
                **answer_of(reading),
                **self._by,
                utc_s=utc_s,
                cell_s=cell_s,
                mission=mission,
                phase=phase,
                told=self._kept.targets.get(reading.name),
                crop=self._kept.history.crops.add(crops[reading.name]) if reading.name in crops else None,
            )
            for reading in readings
        ]
        stored = [replace(one, doubt=self._kept.doubt_of(one)) for one in stored]
        for one in stored:
            if one.doubt and one.crop is not None and (around := surroundings(one.object)) is not None:
                self._kept.history.crops.add_surroundings(one.crop, around)
        stored = [replace(one, certificate=self._kept.certify(one, crops.get(one.object))) for one in stored]
        self._kept.keep(stored)

    def told(self, name: str, target: str) -> None:
        """Note what an object is now told to be; its next reading says so."""
        self._kept.targets[name] = target

    @property
    def asked_by(self) -> str:
        """The key, else the holder of the lease, that asked for the task; see `Observer.asked_by`."""
        return str(self._by["asked_by"])

    def now_s(self) -> float:
        """Return the time by which readings are stamped; see `Observer.now_s`."""
        return self._kept.now_s()

    def newest(self) -> Mapping[str, Mapping[str, Any]]:
        """Return the fields of the newest reading of each object, by its name; see `Observer.newest`."""
        return {reading.object: asdict(reading) for reading in self._kept.history.newest()}

    def alarms(self) -> Sequence[dict[str, str]]:
        """Return the alarms whose condition holds; see `Observer.alarms`."""
        return self._kept.alarms()
