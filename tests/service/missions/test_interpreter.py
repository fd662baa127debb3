"""Tests of running missions: order, conditions before contact, failures, branches, waiting, and taking a mission up."""

from __future__ import annotations

import random
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from hal.errors import CellError, DeviceFault, InvalidRequest, NotFound, Unreachable
from hal.motion import MotionLimits
from hal.strict import validate
from service.errors import StepFailed
from service.missions import interpreter
from service.missions.conditions import Answer, Finding, Seen, answer_of
from service.missions.interpreter import Interpreter, leaves_of
from service.missions.progress import FILE, Progress, load_progress
from service.schema.mission_file import Condition, FeelStep, InspectStep, MissionFile, SetStep, Step, conditions_of

LOW = {"object": "pressure", "below": 6.0, "unit": "bar"}
IS_ON = {"object": "pump", "state": "on"}
OPEN: dict[str, Any] = {"kind": "set", "name": "open", "object": "valve", "state": "open"}


def mission(*steps: dict[str, Any]) -> MissionFile:
    """Return a mission with these steps."""
    return validate({"steps": list(steps)}, MissionFile, source="mission")


class Panel:
    """Hands on a panel of numbers: notes what was done, and fails where it is told to."""

    def __init__(self, **shown: Seen) -> None:
        self.shown = {"pressure": Seen(value=5.0), "pump": Seen(state="on"), **shown}
        self.did: list[str] = []
        self.faults: dict[str, list[CellError | str]] = {}
        self.after_wait: Callable[[Panel], None] = lambda _panel: None
        self.time_s = 0.0

    def _do(self, what: str) -> str:
        self.did.append(what)
        fault = self.faults[what].pop(0) if self.faults.get(what) else ""
        if isinstance(fault, CellError):
            raise fault
        return fault

    def inspect(self, step: InspectStep) -> None:
        self._do(step.name)

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        self._do("look")
        return {name: self.shown[name] for name in names}

    def feel(self, step: FeelStep) -> None:
        self._do(step.name)

    def set(self, step: SetStep) -> str:
        return self._do(step.name)

    def wait(self, duration_s: float) -> None:
        self.time_s += duration_s
        self.after_wait(self)

    def now_s(self) -> float:
        return self.time_s

    def begins(self, path: str, kind: str) -> None:
        pass


def run(panel: Panel, file: MissionFile, **given: Any) -> Interpreter:
    """Run a mission; a failure is left to the caller."""
    made = Interpreter(hands=panel, progress=Progress(mission=file, library=given.pop("library", {})))
    made.run()
    return made


@pytest.mark.parametrize(
    ("seen", "answer"),
    [
        (Seen(value=5.0), "met"),
        (Seen(value=5.9, sigma=0.05), "met"),
        (Seen(value=5.95, sigma=0.05), "unknown"),
        (Seen(value=6.05, sigma=0.05), "unknown"),
        (Seen(value=6.2, sigma=0.05), "unmet"),
        (Seen(value=6.0), "unmet"),
        (Seen(cause="glare"), "unknown"),
        (Seen(state="on"), "unknown"),
        (None, "unknown"),
    ],
)
def test_a_number_is_below_only_if_its_whole_interval_is(seen: Seen | None, answer: str) -> None:
    found, says = answer_of(Condition(**LOW), seen)
    assert found == answer
    assert "pressure" in says


def test_a_needed_condition_that_is_unmet_or_unknown_ends_the_step_before_contact() -> None:
    for seen, word in (
        (Seen(value=7.0), "not below 6"),
        (Seen(cause="glare"), "glare"),
        (Seen(value=6.0, sigma=1), "strad"),
    ):
        panel = Panel(pressure=seen)
        with pytest.raises(StepFailed, match=word):
            run(panel, mission({**OPEN, "needs": [LOW]}))
        assert panel.did == ["look"]


def test_a_required_condition_keeps_everything_after_it_from_beginning() -> None:
    panel = Panel(pump=Seen(state="off"))
    with pytest.raises(StepFailed, match="pump is off, not on"):
        run(panel, mission({"kind": "require", "name": "pump", "conditions": [LOW, IS_ON]}, OPEN))
    assert panel.did == ["look"]


@pytest.mark.parametrize(
    ("on_failure", "faults", "did", "outcomes"),
    [
        ("stop", ["slipped"], ["open"], ["failed"]),
        ("skip", ["slipped"], ["open", "read"], ["skipped", "done"]),
        ("retry", ["slipped"], ["open", "open", "read"], ["done", "done"]),
        ("retry", ["slipped", "slipped"], ["open", "open"], ["failed"]),
        ("retry", [NotFound("no valve", hint="look")], ["open", "open", "read"], ["done", "done"]),
        ("skip", [Unreachable("too far", hint="move")], ["open", "read"], ["skipped", "done"]),
        ("skip", [DeviceFault("the arm is broken", hint="repair", device="arm")], ["open"], ["failed"]),
    ],
)
def test_a_step_that_fails_does_what_its_file_says(
    on_failure: str, faults: list[CellError | str], did: list[str], outcomes: list[str]
) -> None:
    panel = Panel()
    panel.faults["open"] = list(faults)
    progress = Progress(
        mission=mission({**OPEN, "on_failure": on_failure}, {"kind": "inspect", "name": "read"}), library={}
    )
    made = Interpreter(hands=panel, progress=progress)
    try:
        made.run()
    except CellError:
        assert outcomes[-1] == "failed"
    assert panel.did == did
    assert [one.outcome for one in made.outcomes] == outcomes


def test_waiting_looks_until_it_is_so_or_the_time_is_over() -> None:
    wait = {"kind": "wait_until", "name": "wait", "conditions": [LOW], "timeout_s": 30.0, "every_s": 10.0}
    panel = Panel(pressure=Seen(value=7.0))

    def drop(now: Panel) -> None:
        now.shown["pressure"] = Seen(value=7.0 - now.time_s / 12.0)

    panel.after_wait = drop
    run(panel, mission(wait))
    assert (panel.time_s, panel.did) == (20.0, ["look"] * 3)
    panel = Panel(pressure=Seen(value=7.0))
    with pytest.raises(StepFailed, match="has waited 30 s: pressure shows 7 bar, not below 6"):
        run(panel, mission(wait))
    assert panel.time_s == 30.0


def test_a_choice_takes_one_branch_and_none_when_it_cannot_know() -> None:
    choose = {
        "kind": "choose", "name": "c", "when": [LOW],
        "then": [{"kind": "inspect", "name": "low"}], "otherwise": [{"kind": "inspect", "name": "high"}],
    }  # fmt: skip
    for seen, did in ((Seen(value=5.0), "low"), (Seen(value=7.0), "high")):
        panel = Panel(pressure=seen)
        run(panel, mission(choose))
        assert panel.did == ["look", did]
    panel = Panel(pressure=Seen(cause="glare"))
    with pytest.raises(StepFailed, match="cannot choose"):
        run(panel, mission(choose))
    assert panel.did == ["look"]


def test_a_repetition_ends_when_its_condition_is_met() -> None:
    repeat = {"kind": "repeat", "name": "r", "times": 5, "until": [IS_ON], "steps": [OPEN]}
    panel = Panel(pump=Seen(state="off"))
    with pytest.raises(StepFailed, match="has run 5 times"):
        run(panel, mission(repeat))
    assert panel.did.count("open") == 5
    panel = Panel()
    made = run(panel, mission(repeat, {"kind": "repeat", "name": "two", "times": 2, "steps": [{**OPEN, "name": "o"}]}))
    assert [one.path for one in made.outcomes] == ["r#1/open", "r", "two#1/o", "two#2/o", "two"]


def test_a_called_mission_runs_in_the_place_of_its_call() -> None:
    called = mission({"kind": "inspect", "name": "read"})
    made = run(Panel(), mission({"kind": "call", "name": "first", "mission": "round"}, OPEN), library={"round": called})
    assert [one.path for one in made.outcomes] == ["first/read", "first", "open"]
    assert leaves_of(made.progress) == 2


def test_a_mission_is_taken_up_at_its_first_unfinished_step_and_looks_at_its_guards_again(tmp_path: Path) -> None:
    file = mission(
        {"kind": "require", "name": "guard", "conditions": [LOW]},
        {"kind": "repeat", "name": "r", "times": 2, "steps": [OPEN]},
        {"kind": "inspect", "name": "read"},
    )
    panel = Panel()
    panel.faults["open"] = ["", "slipped"]
    kept = Progress(mission=file, library={}, cell="c", panel="p", path=tmp_path / "m" / FILE)
    with pytest.raises(StepFailed):
        Interpreter(hands=panel, progress=kept).run()
    again = load_progress(tmp_path / "m", cell="c", panel="p")
    assert again.done == ["guard", "r#1/open"]
    panel = Panel()
    made = Interpreter(hands=panel, progress=again)
    made.run()
    assert panel.did == ["look", "open", "read"]
    outcomes = [(one.path, one.outcome) for one in made.outcomes]
    assert outcomes[:3] == [("guard", "done"), ("r#1/open", "taken over"), ("r#2/open", "done")]
    panel = Panel(pressure=Seen(value=9.0))
    with pytest.raises(StepFailed, match="guard"):
        Interpreter(hands=panel, progress=load_progress(tmp_path / "m", cell="c", panel="p")).run()
    assert panel.did == ["look"]


def test_a_mission_of_another_cell_a_damaged_one_and_none_are_not_taken_up(tmp_path: Path) -> None:
    Progress(mission=mission(OPEN), library={}, cell="c", panel="p", path=tmp_path / FILE).save()
    with pytest.raises(InvalidRequest, match="ran on cell 'c'"):
        load_progress(tmp_path, cell="d", panel="p")
    (tmp_path / FILE).write_text("{")
    with pytest.raises(InvalidRequest, match="damaged"):
        load_progress(tmp_path, cell="c", panel="p")
    with pytest.raises(InvalidRequest, match="no progress"):
        load_progress(tmp_path / "none", cell="c", panel="p")


class Watched(Panel):
    """A panel that changes at random, and checks that no deed begins on what is not known to be so now."""

    def __init__(self, rng: random.Random, progress: Progress) -> None:
        super().__init__()
        self.rng, self.progress = rng, progress
        self.newest: Mapping[str, Seen] = {}
        self.deeds, self.wrong = 0, 0

    def look(self, names: Collection[str]) -> Mapping[str, Seen]:
        if self.rng.random() < 0.05:
            raise NotFound("the panel is not there", hint="look")
        value, state = self.rng.uniform(3.5, 6.8), self.rng.choice(["on", "on", "on", "off", None])
        pressure = (
            Seen(cause="glare") if self.rng.random() < 0.1 else Seen(value=value, sigma=self.rng.choice([0.0, 0.3]))
        )
        pump = Seen(cause="dark") if state is None else Seen(state=state)
        self.newest = {"pressure": pressure, "pump": pump}
        return {name: self.newest[name] for name in names}

    def _check(self, step: Step) -> None:
        self.deeds += 1
        if step.needs and any(_truth(condition, self.newest) is not True for condition in step.needs):
            self.wrong += 1

    def set(self, step: SetStep) -> str:
        self._check(step)
        self._forget()
        return self.rng.choice(["", "", "slipped"])

    def feel(self, step: FeelStep) -> None:
        self._check(step)
        self._forget()

    def _forget(self) -> None:
        self.newest = {}


def _truth(condition: Condition, seen: Mapping[str, Seen]) -> bool | None:
    """Return whether a condition is met, by brute force over the interval; None if that is not known."""
    one = seen.get(condition.object)
    if one is None or one.cause is not None:
        return None
    if condition.state is not None:
        return one.state == condition.state
    assert one.value is not None
    places = [one.value + 1.96 * one.sigma * k / 50.0 for k in range(-50, 51)]
    low, high = condition.above, condition.below
    inside = [(high is None or v < high) and (low is None or v > low) for v in places]
    return inside[0] if len(set(inside)) == 1 else None


def random_steps(rng: random.Random, depth: int, count: list[int]) -> list[dict[str, Any]]:
    """Return random steps, nested at most `depth` deep."""
    steps = []
    for _ in range(rng.randint(1, 4)):
        count[0] += 1
        number = count[0]
        some = rng.sample([LOW, IS_ON, {"object": "pressure", "above": 4.0, "unit": "bar"}], rng.randint(1, 2))
        kinds: dict[str, dict[str, Any]] = {
            "set": {"object": "valve", "state": "open"},
            "feel": {},
            "inspect": {},
            "require": {"conditions": some},
            "wait_until": {"conditions": some, "timeout_s": 20.0},
        }
        if depth:
            kinds |= {
                "choose": {"when": some, "then": random_steps(rng, depth - 1, count)},
                "repeat": {"times": 2, "steps": random_steps(rng, depth - 1, count)},
            }
        kind = rng.choice([*kinds, "set", "set", "feel"])
        needs = rng.sample([LOW, IS_ON], rng.randint(0, 2))
        on_failure = rng.choice(["stop", "skip", "retry", "skip"])
        steps.append({"kind": kind, "name": f"s{number}", "needs": needs, "on_failure": on_failure, **kinds[kind]})
    return steps


def watched_runs(count: int) -> tuple[int, int]:
    """Run random missions on random panels; returns the deeds, and those begun on what was unmet or unknown."""
    deeds = wrong = 0
    for seed in range(count):
        rng = random.Random(seed)
        progress = Progress(mission=mission(*random_steps(rng, 2, [0])), library={})
        panel = Watched(rng, progress)
        with suppress(CellError):
            Interpreter(hands=panel, progress=progress).run()
        deeds, wrong = deeds + panel.deeds, wrong + panel.wrong
    return deeds, wrong


def test_in_1000_random_missions_no_deed_begins_on_an_unmet_or_unknown_condition() -> None:
    deeds, wrong = watched_runs(1000)
    assert deeds > 500
    assert wrong == 0


def test_the_random_missions_find_planted_defects(monkeypatch: pytest.MonkeyPatch) -> None:
    real = interpreter.judge

    def lenient(conditions: Any, seen: Any) -> Finding:
        found = real(conditions, seen)
        return Finding(answer=Answer.MET) if found.answer is Answer.UNKNOWN else found

    monkeypatch.setattr(interpreter, "judge", lenient)
    assert watched_runs(100)[1] > 0
    monkeypatch.setattr(interpreter, "judge", lambda conditions, _seen: real(list(conditions)[:1], _seen))
    assert watched_runs(100)[1] > 0


def test_every_condition_of_a_step_is_found() -> None:
    both = {"kind": "require", "name": "r", "needs": [LOW], "conditions": [IS_ON]}
    assert [one.object for one in conditions_of(mission(both).steps[0])] == ["pressure", "pump"]


def test_the_strictest_limits_of_a_mission_and_of_those_that_it_calls_hold() -> None:
    def limited(**limits: float) -> MissionFile:
        return validate({"steps": [OPEN], "limits": limits}, MissionFile, source="mission")

    alone = Progress(mission=mission(OPEN), library={})
    assert alone.limits() == MotionLimits()
    called = {"inner": limited(speed_m_per_s=0.05, force_n=60.0)}
    both = Progress(mission=limited(speed_m_per_s=0.1, force_n=20.0), library=called)
    assert both.limits() == MotionLimits(speed_m_per_s=0.05, force_n=20.0)
    with pytest.raises(CellError, match=r"limits\.force_n"):
        limited(force_n=-1.0)
