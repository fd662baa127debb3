"""Figures of the plant that need no cell: anomalies, conditions, certificate and its regime. See `benchmarks.plant`."""

from __future__ import annotations

import random
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from hal.errors import CellError, DeviceFault, NotFound
from hal.panel import Panel
from hal.strict import validate
from service.alarms.desk import AlarmDesk
from service.certificate.bound import wrong_at_most
from service.certificate.record import Case, kinds_of
from service.certificate.regime import features_of, outside
from service.history.reading import INVALID, VALID, StoredReading
from service.missions.conditions import Seen
from service.missions.interpreter import Interpreter
from service.missions.progress import Progress
from service.review.doubts import Doubts
from service.schema.mission_file import Condition, FeelStep, InspectStep, MissionFile, SetStep, Step

HOUR_S = 3600.0
SIGMA_BAR, LOW_BAR, HIGH_BAR, RATE_BAR = 0.05, 2.0, 6.0, 1.0  # rate: per hour
PLANTED_SIGMAS, NORMAL_SIGMAS = 3.0, 4.0  # how far beyond the limit, and at least inside of it
GAUGE = {
    "kind": "gauge", "name": "pressure", "position_m": [0.0, 0.0], "radius_m": 0.03,
    "scale": {"minimum": 0.0, "maximum": 10.0, "unit": "bar", "at_min": -2.3, "at_max": 2.3},
    "limits": {"low": LOW_BAR, "high": HIGH_BAR, "rate_per_s": RATE_BAR / HOUR_S},
}  # fmt: skip
LAMP = {"kind": "lamp", "name": "pump", "position_m": [0.1, 0.1], "radius_m": 0.01, "normal": ["on"]}
ANOMALIES = ("high", "low", "jump", "state", "refused")
BELOW = {"object": "pressure", "below": 6.0, "unit": "bar"}
ABOVE = {"object": "pressure", "above": 4.0, "unit": "bar"}
IS_ON = {"object": "pump", "state": "on"}


def anomalies(seed: int, *, planted: int = 200, normal: int = 10_000) -> tuple[int, int]:
    """Return how many of the planted anomalies were found, and how many normal readings raised something.

    A gauge (sigma 0.05 bar) and a lamp are read each hour. Normal values drift anywhere 4 sigma inside of the limits. Planted
    are, in turn: 3 sigma above or below a limit, a jump inside of the limits of 1.5 times the greatest change, a wrong state,
    and a refusal. Found is what raises an alarm or waits for a person.
    """
    panel = validate({"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [GAUGE, LAMP]}, Panel, source="p")
    rng, hour, found, false = random.Random(seed), 0, 0, 0
    every = normal // planted
    with TemporaryDirectory() as folder:
        clock = [0.0]
        desk = AlarmDesk(panel, path=Path(folder) / "a.json", commit=lambda _kind, _data: None, now_s=lambda: clock[0])
        desk._save = lambda: None  # type: ignore[method-assign]  # the file is not what is measured
        doubts, value = Doubts(panel, sure_at=0.8), 4.0

        def raises(*readings: StoredReading) -> bool:
            doubtful = [doubts.of(one) != "" for one in readings]
            desk.take(readings)
            return any(doubtful) or any(alarm.is_active for alarm in desk.all())

        for number in range(normal // 2 + planted):
            hour += 1
            clock[0] = hour * HOUR_S
            step = rng.gauss(0.0, 0.1)
            value = min(max(value + step, LOW_BAR + NORMAL_SIGMAS * SIGMA_BAR), HIGH_BAR - NORMAL_SIGMAS * SIGMA_BAR)
            false += raises(*_hour(clock[0], rng.gauss(value, SIGMA_BAR)))
            if number % (every // 2 + 1) == 0 and number // (every // 2 + 1) < planted:
                kind = ANOMALIES[number // (every // 2 + 1) % len(ANOMALIES)]
                hour += 1
                clock[0] = hour * HOUR_S
                found += raises(*_planted(kind, clock[0], value, rng))
                for _ in range(2):  # back to normal before the next normal reading counts
                    hour += 1
                    clock[0] = hour * HOUR_S
                    raises(*_hour(clock[0], rng.gauss(value, SIGMA_BAR)))
    return found, false


def _hour(utc_s: float, value: float | None, *, state: str = "on") -> list[StoredReading]:
    given: dict[str, Any] = {"utc_s": utc_s, "cell_s": utc_s, "confidence": 0.95}
    is_read = value is not None
    gauge = StoredReading(
        object="pressure", kind="gauge", quality=VALID if is_read else INVALID, cause="" if is_read else "glare",
        value=value, unit="bar", sigma=SIGMA_BAR if is_read else None, **given,
    )  # fmt: skip
    return [gauge, StoredReading(object="pump", kind="lamp", quality=VALID, state=state, **given)]


def _planted(kind: str, utc_s: float, value: float, rng: random.Random) -> list[StoredReading]:
    beyond = PLANTED_SIGMAS * SIGMA_BAR
    match kind:
        case "high":
            return _hour(utc_s, rng.gauss(HIGH_BAR + beyond, SIGMA_BAR))
        case "low":
            return _hour(utc_s, rng.gauss(LOW_BAR - beyond, SIGMA_BAR))
        case "jump":
            away = 1.5 * RATE_BAR if value < (LOW_BAR + HIGH_BAR) / 2 else -1.5 * RATE_BAR
            return _hour(utc_s, rng.gauss(value + away, SIGMA_BAR))
        case "state":
            return _hour(utc_s, rng.gauss(value, SIGMA_BAR), state="off")
        case _:
            return _hour(utc_s, None)


@dataclass(slots=True)
class Hands:
    """Hands on a panel that changes at random and fails at random; checks each step against what was seen for it.

    Attributes:
        seen: what the newest look has shown, which a deed that follows uses up.
        begun: deeds that began; `wrong` of them on a condition that was unmet or unknown.
    """

    rng: random.Random
    seen: dict[str, Seen] = field(default_factory=dict)
    begun: int = 0
    wrong: int = 0
    time_s: float = 0.0

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        """Return what the objects show; sometimes the panel is not found."""
        if self.rng.random() < 0.05:
            raise NotFound("the panel is not there", hint="look again")
        value, sigma = self.rng.uniform(3.5, 6.8), self.rng.choice([0.0, 0.3])
        pressure = Seen(cause="glare") if self.rng.random() < 0.1 else Seen(value=value, sigma=sigma)
        pump = Seen(cause="dark") if self.rng.random() < 0.1 else Seen(state=self.rng.choice(["on", "on", "off"]))
        self.seen = {name: {"pressure": pressure, "pump": pump}[name] for name in names}
        return self.seen

    def set(self, step: SetStep) -> str:
        """Operate, which changes the panel."""
        self._begin(step)
        return self.rng.choice(["", "", "slipped"])

    def feel(self, step: FeelStep) -> None:
        """Touch, which may move the panel; sometimes a device fails."""
        self._begin(step)

    def inspect(self, step: InspectStep) -> None:
        """Read without contact."""

    def wait(self, duration_s: float) -> None:
        """Let time pass."""
        self.time_s += duration_s

    def now_s(self) -> float:
        """Return the time."""
        return self.time_s

    def begins(self, path: str, kind: str) -> None:
        """Take note of a step."""

    def _begin(self, step: Step) -> None:
        self.begun += 1
        self.wrong += any(not _is_met(condition, self.seen.get(condition.object)) for condition in step.needs)
        self.seen = {}
        if self.rng.random() < 0.03:
            raise DeviceFault("the gripper does not answer", hint="see its cable", device="gripper")


def _is_met(condition: Condition, seen: Seen | None) -> bool:
    """Return whether a condition is certainly met, by brute force over the interval of 1.96 sigma."""
    if seen is None or seen.cause is not None:
        return False
    if condition.state is not None:
        return seen.state == condition.state
    places = [(seen.value or 0.0) + 1.96 * seen.sigma * k / 50.0 for k in range(-50, 51)]
    low, high = condition.above, condition.below
    return all((high is None or place < high) and (low is None or place > low) for place in places)


def conditions(first: int, *, missions: int = 1000) -> tuple[int, int]:
    """Run random mission files with random faults; returns the deeds begun, and those on an unmet or unknown condition."""
    begun = wrong = 0
    for seed in range(first, first + missions):
        rng = random.Random(seed)
        plain = {"steps": list(_steps(rng, 2, [0]))}
        hands = Hands(rng)
        progress = Progress(mission=validate(plain, MissionFile, source="mission"), library={})
        with suppress(CellError):
            Interpreter(hands=hands, progress=progress).run()
        begun, wrong = begun + hands.begun, wrong + hands.wrong
    return begun, wrong


def _steps(rng: random.Random, depth: int, count: list[int]) -> Iterator[dict[str, Any]]:
    for _ in range(rng.randint(1, 4)):
        count[0] += 1
        name = f"s{count[0]}"
        some = rng.sample([BELOW, IS_ON, ABOVE], rng.randint(1, 2))
        kind = rng.choice(
            ["set", "set", "feel", "inspect", "require", "wait_until", *["choose", "repeat"] * (depth > 0)]
        )
        own: dict[str, Any] = {}
        match kind:
            case "set":
                own = {"object": "valve", "state": "open"}
            case "require" | "wait_until":
                own = {"conditions": some, **({"timeout_s": 20.0} if kind == "wait_until" else {})}
            case "choose":
                own = {"when": some, "then": list(_steps(rng, depth - 1, count))}
            case "repeat":
                own = {"times": 2, "steps": list(_steps(rng, depth - 1, count))}
        needs = rng.sample([BELOW, IS_ON], rng.randint(0, 2))
        on_failure = rng.choice(["stop", "skip", "retry", "skip"])
        yield {"kind": kind, "name": name, "needs": needs, "on_failure": on_failure, **own}


def certificate(seed: int, *, splits: int = 400, rate: float = 0.02) -> int:
    """Return in how many random splits of 20,000 judged readings the bound of 600 is exceeded by the other ones."""
    rng = np.random.default_rng(seed)
    pool = np.arange(20_000) < 20_000 * rate
    fails = 0
    for _ in range(splits):
        rng.shuffle(pool)
        judged, rest = pool[:600], pool[600:]
        fails += bool(rest.mean() > wrong_at_most(int(judged.sum()), len(judged)))
    return fails


def regime(seed: int, *, cases: int = 300, others: int = 1000) -> tuple[int, int]:
    """Return how many of so many pictures outside of the judged ones are taken for like them, and how many of those inside.

    Drawn dials: judged are those of usual blur, contrast, light and size. Outside lie, in turn: blur, low contrast, dark and
    bright pictures, glare, and another size, each from just noticeable to strong.
    """
    rng = np.random.default_rng(seed)

    def usual() -> dict[str, float]:
        return {
            "blur": rng.uniform(0.6, 1.2), "contrast": rng.uniform(0.8, 1.0), "add": rng.uniform(-10, 10),
            "side": float(rng.integers(55, 70)), "glare": 0.0,
        }  # fmt: skip

    def judged() -> Case:
        found = features_of(dial(**usual()))
        assert found is not None
        return Case(kind="gauge", cluster=str(rng.random()), is_wrong=False, features=found)

    box = kinds_of([judged() for _ in range(cases)])["gauge"].regime
    changes: list[dict[str, tuple[float, float]]] = [
        {"blur": (2.0, 5.0)}, {"contrast": (0.2, 0.65)}, {"add": (-90.0, -30.0)}, {"add": (30.0, 60.0)},
        {"glare": (0.1, 0.5)}, {"side": (90.0, 200.0)}, {"side": (20.0, 45.0)},
    ]  # fmt: skip
    wrong = 0
    for k in range(others):
        changed = {name: rng.uniform(*span) for name, span in changes[k % len(changes)].items()}
        wrong += _is_inside(box, usual() | changed)
    return wrong, sum(_is_inside(box, usual()) for _ in range(others))


def _is_inside(box: dict[str, tuple[float, float]], given: dict[str, float]) -> bool:
    found = features_of(dial(**given))
    return found is not None and not outside(box, found)


def dial(*, blur: float, contrast: float, add: float, side: float, glare: float) -> bytes:
    """Return the picture of a dial as PNG; `glare` is the share of each side that a bright patch covers."""
    px = int(side)
    picture = np.full((px, px), 200.0, np.float32)
    cv2.circle(picture, (px // 2, px // 2), px // 3, (40.0,), 2)
    cv2.line(picture, (px // 2, px // 2), (px // 2 + px // 4, px // 3), (20.0,), 2)
    blurred = cv2.GaussianBlur(picture, (0, 0), blur)
    seen = np.clip((blurred - 120.0) * contrast + 120.0 + add, 0, 249)
    if glare:
        seen[: int(glare * px), : int(glare * px)] = 255
    return bytes(cv2.imencode(".png", seen.astype(np.uint8))[1])
