"""Tests of conditions and desk: limits, deadband, delay, rate, refusals, age, people, restarts and a full disk."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from hal.errors import ConfigError, InvalidRequest
from hal.panel import Panel
from hal.strict import parse_toml, validate
from service.alarms.conditions import Watch
from service.alarms.desk import THE_CELL, AlarmDesk
from service.alarms.lifecycle import State
from service.errors import JournalError, NoSuchTask
from service.history.reading import INVALID, VALID, StoredReading

START_S = 1_790_000_000.0
SCALE = {"minimum": 0.0, "maximum": 10.0, "unit": "bar", "at_min": -2.3, "at_max": 2.3}


class Rig:
    """A desk with a clock and a journal that tests set."""

    def __init__(self, folder: Path, **keys: Any) -> None:
        gauge = {
            "kind": "gauge",
            "name": "pressure",
            "position_m": [0.0, 0.0],
            "radius_m": 0.03,
            "scale": SCALE,
            **keys,
        }
        valve = {"kind": "lamp", "name": "pump", "position_m": [0.1, 0.1], "radius_m": 0.01, "normal": ["on"]}
        plate = {"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [gauge, valve]}
        self.panel = validate(plate, Panel, source="panel.toml")
        self.folder, self.now_s, self.is_full = folder, START_S, False
        self.journal: list[dict[str, Any]] = []
        self.desk = self.started()

    def started(self, **given: Any) -> AlarmDesk:
        """Return a desk as after a start of the service."""
        path = self.folder / "alarms.json"
        return AlarmDesk(self.panel, path=path, commit=self.commit, now_s=lambda: self.now_s, **given)

    def commit(self, kind: str, data: dict[str, Any]) -> None:
        if self.is_full:
            raise JournalError("the journal cannot be written", hint="free disk space")
        assert kind == "alarm"
        self.journal.append(data)

    def reads(self, value: float | None, *, at_s: float = 1.0, **given: Any) -> None:
        """Let `at_s` seconds pass, then read the gauge (or another object); None is a refused reading."""
        self.now_s += at_s
        is_valid = value is not None or "state" in given
        plain = {"object": "pressure", "kind": "gauge", "utc_s": self.now_s, "cell_s": self.now_s - START_S}
        plain |= {"quality": VALID if is_valid else INVALID, "cause": "" if is_valid else "glare", "value": value}
        self.desk.take([StoredReading(**{**plain, **given})])

    def states(self) -> dict[str, str]:
        """Return the states of all alarms that are not normal."""
        return {alarm.id: str(alarm.state) for alarm in self.desk.all() if alarm.state is not State.NORMAL}


def test_each_limit_is_an_alarm_of_its_own_and_returns_through_its_acknowledgement(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"low": 2.0, "high": 6.0, "high_high": 8.0})
    rig.reads(5.0)
    assert rig.states() == {}
    rig.reads(9.0)
    assert rig.states() == {"pressure.high": "unacknowledged", "pressure.high_high": "unacknowledged"}
    rig.desk.acknowledge("pressure.high", by="alice")
    rig.reads(7.0)
    assert rig.states() == {"pressure.high": "acknowledged", "pressure.high_high": "returned-unacknowledged"}
    rig.desk.acknowledge("pressure.high_high", by="alice", reason="seen on site")
    rig.reads(1.0)
    assert rig.states() == {"pressure.low": "unacknowledged"}
    assert rig.desk.get("pressure.low").says == "pressure shows 1 bar, below low 2"
    changes = [(row["object"] + "." + row["kind"], row["before"], row["state"], row["by"]) for row in rig.journal]
    assert changes == [
        ("pressure.high", "normal", "unacknowledged", THE_CELL),
        ("pressure.high_high", "normal", "unacknowledged", THE_CELL),
        ("pressure.high", "unacknowledged", "acknowledged", "alice"),
        ("pressure.high_high", "unacknowledged", "returned-unacknowledged", THE_CELL),
        ("pressure.high_high", "returned-unacknowledged", "normal", "alice"),
        ("pressure.high", "acknowledged", "normal", THE_CELL),
        ("pressure.low", "normal", "unacknowledged", THE_CELL),
    ]


def test_the_deadband_keeps_an_alarm_until_the_value_is_well_inside(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0, "deadband": 0.5})
    active = []
    for value in (5.9, 6.1, 5.9, 5.6, 5.4, 5.9):
        rig.reads(value)
        active.append(rig.desk.get("pressure.high").is_active)
    assert active == [False, True, True, True, False, False]


def test_a_delay_is_waited_for_also_without_a_new_reading(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0, "delay_s": 10.0})
    rig.reads(7.0)
    rig.reads(5.0, at_s=9.0)
    rig.reads(7.0, at_s=9.0)
    rig.now_s += 9.9
    rig.desk.tick()
    assert rig.states() == {}
    rig.now_s += 0.2
    rig.desk.tick()
    assert rig.states() == {"pressure.high": "unacknowledged"}


def test_a_rate_is_judged_on_the_cells_clock(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"rate_per_s": 0.5})
    rig.reads(1.0)
    rig.reads(1.9, at_s=2.0)
    assert rig.states() == {}
    rig.reads(3.0, at_s=2.0)
    assert rig.states() == {"pressure.rate": "unacknowledged"}
    assert "0.55 bar/s" in rig.desk.get("pressure.rate").says


def test_a_refused_reading_is_an_alarm_and_brings_nothing_back_to_normal(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0})
    rig.reads(7.0)
    rig.reads(None)
    assert rig.states() == {"pressure.high": "unacknowledged", "pressure.refused": "unacknowledged"}
    assert "glare" in rig.desk.get("pressure.refused").says
    rig.reads(5.0)
    assert set(rig.states().values()) == {"returned-unacknowledged"}


def test_a_reading_becomes_stale_and_only_a_valid_one_ends_that(tmp_path: Path) -> None:
    rig = Rig(tmp_path, stale_after_s=100.0)
    rig.reads(5.0)
    for value, wanted in ((None, True), (5.0, False)):
        rig.now_s += 101.0
        rig.desk.tick()
        assert rig.desk.get("pressure.stale").is_active
        rig.reads(value)
        rig.desk.tick()
        assert rig.desk.get("pressure.stale").is_active is wanted
    rig.desk = rig.started(valid_at_s={"pressure": rig.now_s - 200.0})
    rig.desk.tick()
    assert rig.desk.get("pressure.stale").is_active, "the age goes on over a restart"


def test_an_interval_over_a_limit_says_so_on_both_sides(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0})
    rig.reads(5.9, sigma=0.1)
    assert rig.states() == {}
    told = "pressure shows 5.9 bar, within high 6; its interval 5.704 to 6.096 straddles that limit"
    assert rig.desk.doubts() == {"pressure.high": told}
    rig.reads(6.1, sigma=0.1)
    assert rig.desk.get("pressure.high").straddles and "straddles" in rig.desk.get("pressure.high").says
    rig.reads(7.0, sigma=0.1)
    assert not rig.desk.get("pressure.high").straddles
    assert rig.desk.doubts() == {}


def test_another_than_a_normal_state_is_an_alarm(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.reads(None, object="pump", state="off")
    assert rig.states() == {"pump.state": "unacknowledged"}
    rig.reads(None, object="pump", state="on")
    assert rig.states() == {"pump.state": "returned-unacknowledged"}
    rig.reads(None)
    assert "pressure.refused" not in rig.states(), "an object without limits has no alarms"


def test_shelving_ends_by_itself_and_shows_what_holds_then(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0})
    rig.desk.shelve("pressure.high", until_s=rig.now_s + 60.0, by="alice", reason="test run")
    rig.reads(7.0)
    assert rig.states() == {"pressure.high": "shelved"}
    rig.now_s += 60.0
    rig.desk.tick()
    assert rig.states() == {"pressure.high": "unacknowledged"}
    assert rig.journal[-1]["by"] == THE_CELL
    for until_s in (rig.now_s - 1.0, rig.now_s + 32 * 86_400.0):
        with pytest.raises(InvalidRequest, match="31 days"):
            rig.desk.shelve("pressure.high", until_s=until_s, by="alice", reason="x")
    with pytest.raises(NoSuchTask):
        rig.desk.acknowledge("pressure.hihg", by="alice")


@pytest.mark.parametrize("lost", ["nothing", "the file", "the newest save", "a torn file"])
def test_states_survive_a_restart(tmp_path: Path, lost: str) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0, "low": 2.0})
    rig.reads(7.0)
    rig.desk.shelve("pressure.low", until_s=rig.now_s + 600.0, by="alice", reason="x")
    old = (tmp_path / "alarms.json").read_text()
    rig.desk.acknowledge("pressure.high", by="alice")
    before = rig.desk.all()
    match lost:
        case "the file":
            (tmp_path / "alarms.json").unlink()
        case "the newest save":
            (tmp_path / "alarms.json").write_text(old)
        case "a torn file":
            (tmp_path / "alarms.json").write_text(old[:50])
    rig.desk = rig.started(recorded=rig.journal)
    assert rig.desk.all() == before
    rig.desk.unshelve("pressure.low", by="bob")
    numbers = [row["number"] for row in rig.journal]
    assert numbers == sorted(set(numbers))


def test_what_cannot_be_recorded_does_not_take_place_and_is_made_up_for_later(tmp_path: Path) -> None:
    rig = Rig(tmp_path, limits={"high": 6.0})
    rig.is_full = True
    with pytest.raises(JournalError):
        rig.reads(7.0)
    rig.desk.tick()
    assert rig.states() == {}
    rig.is_full = False
    rig.desk.tick()
    assert rig.states() == {"pressure.high": "unacknowledged"}
    rig.is_full = True
    with pytest.raises(JournalError):
        rig.desk.acknowledge("pressure.high", by="alice")
    assert rig.states() == {"pressure.high": "unacknowledged"}


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"limits": {"low": 6.0, "high": 5.0}}, "low = 6 is not below high = 5"),
        (
            {"limits": {"low_low": 3.0, "low": 2.0, "high": 5.0, "high_high": 4.0, "deadband": 9.0}},
            "low_low = 3 is not below low = 2; high = 5 is not below high_high = 4; deadband = 9 is not smaller",
        ),
        ({"limits": {}}, "no limit is given"),
        ({"limits": {"low": 4.0, "high": 5.0, "deadband": 1.0}}, "deadband = 1"),
        ({"limits": {"high": 5.0, "delay_s": -1.0}}, "is not at least 0"),
        ({"limits": {"hihg": 5.0}}, "unknown key 'hihg'"),
        ({"normal": ["on"]}, "shows a value and no state"),
        ({"priority": "huge"}, "priority"),
    ],
)
def test_a_limit_that_cannot_be_meant_is_refused_with_its_key(tmp_path: Path, keys: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Rig(tmp_path, **keys)
    assert words in caught.value.what
    assert "objects.0" in caught.value.what


def test_the_objects_of_the_page_are_watched() -> None:
    page = (Path(__file__).parents[3] / "docs/how-to/watch-limits.md").read_text()
    (block,) = re.findall(r"```toml\n(.*?)```", page, flags=re.DOTALL)
    panel = parse_toml('name = "p"\nwidth_m = 0.6\nheight_m = 0.5\n' + block, Panel, source="page")
    assert [Watch(panel_object=one, valid_at_s=0.0).kinds for one in panel.objects] == [
        ("low_low", "low", "high", "high_high", "rate", "stale", "refused"),
        ("state", "refused"),
    ]


def test_all_faults_of_limits_and_states_are_told_at_once() -> None:
    lamp = {"kind": "lamp", "name": "pump", "position_m": [0.1, 0.1], "radius_m": 0.01, "normal": ["onn"]}
    other = {**lamp, "name": "fan", "position_m": [-0.1, 0.1], "normal": ["on"], "limits": {"high": 1.0}}
    plate = {"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [lamp, other]}
    with pytest.raises(ConfigError) as caught:
        validate(plate, Panel, source="panel.toml")
    faults = " ".join(caught.value.details["faults"])
    assert "objects.0.normal.0: pump has no state 'onn'; its states: on, off" in faults
    assert "objects.1.limits: a lamp shows states and no value" in faults


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"limits": {"high": 60.0, "low": -3.0}},
            "objects.0.limits.high: pressure shows 0 to 10 bar, and no value is beyond 60",
        ),
        ({"limits": {"high": 3.0, "deadband": 5.0}}, "objects.0.limits.deadband: pressure shows 0 to 10 bar"),
        ({"limits": {"high": 3.0, "delay_s": 1e9}}, "objects.0.limits.delay_s: 1000000000.0 is not at most 604800"),
        ({"what_to_do": "a\0b"}, "write one line without control characters"),
    ],
)
def test_limits_that_no_value_can_reach_or_leave_are_refused(given: dict[str, Any], told: str) -> None:
    scale = {"minimum": 0.0, "maximum": 10.0, "unit": "bar", "at_min": -2.0, "at_max": 2.0}
    gauge = {"kind": "gauge", "name": "pressure", "position_m": [0.1, 0.1], "radius_m": 0.03, "scale": scale, **given}
    with pytest.raises(ConfigError) as caught:
        validate({"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [gauge]}, Panel, source="panel.toml")
    assert told in " ".join(caught.value.details["faults"])


def test_states_that_are_all_normal_would_never_raise_an_alarm() -> None:
    lamp = {"kind": "lamp", "name": "pump", "position_m": [0.1, 0.1], "radius_m": 0.01, "normal": ["on", "off"]}
    with pytest.raises(ConfigError, match="every state is normal"):
        validate({"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [lamp]}, Panel, source="panel.toml")
