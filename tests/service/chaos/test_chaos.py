"""Chaos finds what breaks a promise, and a sound service keeps its promises under it."""

from __future__ import annotations

import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from hal.child_python import module_command
from service.chaos.acks import Ack, missing
from service.chaos.faults import FAULTS, LAPSED_S, ODD_BODIES, ends
from service.chaos.judge import last_line, unnamed
from service.chaos.options import ChaosOptions, Round
from service.chaos.plant import Plant
from service.chaos.run import Chaos
from service.chaos.table import report, write
from service.chaos.watch import BACK_S, REST_S, STILL_RAD, Sight, motions_while_latched
from service.schema.mission_results import REPORTING
from service.tasks.journal_reader import Record
from tests.service.conftest import WriteCell
from tests.service.verbs import EchoRequest


@pytest.mark.timeout(300)
def test_a_service_keeps_its_promises_while_it_is_stopped_and_fed_with_garbage(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    cell = write_cell(robot=True)
    plant = Plant(
        command=lambda port, stop_port, runs: module_command(
            "tests.service.chaos.served", str(cell), str(port), str(stop_port), str(runs)
        ),
        runs=tmp_path / "runs",
    )
    faults = ("stop", "corrupt requests")
    options = ChaosOptions(seed=3, rounds=2, verb="hold", body={}, longest_s=0.3, patience=0.1, faults=faults)
    chaos = Chaos(plant, options, arm="arm", devices=())
    rounds = list(chaos.rounds())
    text = report(rounds, chaos.final)
    assert "0 breaches" in text, text + "".join(plant.lines)
    assert sorted(one.fault for one in rounds) == sorted(faults)
    assert next(one for one in rounds if one.fault == "stop").ended.startswith("failed")
    files = write(tmp_path / "out", rounds, chaos.final, lines=plant.lines)
    assert [file.name for file in files] == ["chaos.md", "chaos.json", "service.log"]
    assert len(json.loads(files[1].read_text())) == 3


@pytest.mark.parametrize("body", ODD_BODIES)
def test_no_beginning_of_a_broken_body_is_a_request_of_a_verb_that_needs_no_facts(body: bytes) -> None:
    for cut in range(1, len(body) + 1):
        with pytest.raises(ValidationError):
            EchoRequest.model_validate_json(body[:cut])


def sights(*rows: tuple[float, str | None, float]) -> list[Sight]:
    return [Sight(at_s=t, stop=None if stop is None else (stop,), position_rad=(0.0, q)) for t, stop, q in rows]


def test_a_motion_under_a_latched_stop_is_found_once_the_arm_had_time_to_rest() -> None:
    late = REST_S + 0.1
    assert motions_while_latched(sights((0.0, "a", 0.0), (late, "a", 0.5), (late + 1, "a", 0.5 + 2 * STILL_RAD)))
    for still in (
        sights((0.0, "a", 0.0), (1.0, "a", 0.5), (late, "a", 0.6), (late + 1, "a", 0.6)),  # it came to rest
        sights((0.0, "a", 0.0), (late, "a", 0.0), (late + 1, "b", 1.0), (late + 2, "b", 1.0)),  # another stop
        sights((0.0, "a", 0.0), (late, "a", 0.0), (late + 1, None, 0.0), (late + 2, "a", 1.0)),  # clear in between
        sights((0.0, None, 0.0), (late, None, 1.0), (2 * late, None, 2.0)),
    ):
        assert motions_while_latched(still) == []


def test_an_arm_that_may_go_back_has_longer_to_come_to_rest() -> None:
    late = REST_S + 0.1
    moved = sights((0.0, "a", 0.0), (late, "a", 0.5), (late + 1, "a", 0.5 + 2 * STILL_RAD))
    assert motions_while_latched([replace(sight, rest_s=REST_S + BACK_S) for sight in moved]) == []


def test_a_signal_that_the_service_would_inherit_as_ignored_is_not_chosen() -> None:
    # A shell that runs the tests in the background ignores SIGINT, too.
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGTERM, signal.SIGINT)}
    before[signal.SIGHUP] = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert ends() == [signal.SIGTERM, signal.SIGINT]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def record(kind: str, **data: Any) -> Record:
    return Record(id=1, wall_time_s=0.0, monotonic_s=0.0, kind=kind, data=data, previous_hash="", hash="")


def test_an_acknowledgement_without_its_record_is_lost_also_when_another_life_has_the_same() -> None:
    journal = [
        record("service-start"),
        record("task-queued", task="a"),
        record("stop", count=3),
        record("service-start"),
        record("lease-acquired", holder="chaos-1"),
    ]
    kept = [Ack(1, "task-queued", "a"), Ack(1, "stop", "3"), Ack(2, "lease-acquired", "chaos-1")]
    lost = [Ack(2, "stop", "3"), Ack(1, "task-queued", "b"), Ack(1, "stop-reset", "3")]
    assert missing([*kept, *lost], journal) == lost


def test_a_failure_has_a_cause_and_a_remedy_and_is_no_defect() -> None:
    sound = {"type": "urn:panelwright:device-fault", "detail": "wrist_ft is silent", "hint": "look at its cable"}
    assert unnamed(sound) == []
    assert unnamed({**sound, "hint": ""}) == ["unnamed failure: a task failed without cause or remedy"]
    assert unnamed({**sound, "type": "urn:panelwright:defect"}) == ["unnamed failure: wrist_ft is silent"]
    assert last_line(['  File "x.py"\n', "    f()\n", "ValueError: no\n", "next\n"]) == "ValueError: no"


def test_the_table_counts_and_lists_the_breaches() -> None:
    rounds = [
        Round(number=1, fault="stop", ended="failed stopped", followed_s=0.1, back_s=0.2),
        Round(number=2, fault="stop", what="answered", followed_s=0.3, back_s=0.4, breaches=["ack lost: stop 3"]),
    ]
    text = report(rounds, Round(number=0, fault="the whole run"))
    assert "| stop | 2 | 1 | 1 failed stopped | 0.2, 0.3 | 0.3, 0.4 |" in text
    assert "- round 2, stop (answered): ack lost: stop 3" in text


@pytest.mark.parametrize(
    ("state", "step", "fault", "is_over"),
    [
        ("running", "park", "kill world", False),
        ("running", REPORTING, "kill world", True),
        ("running", REPORTING, "fill disk", False),
        ("failed", REPORTING, "kill world", True),
        ("succeeded", "", "fill disk", True),
    ],
)
def test_a_mission_that_only_writes_its_report_need_not_be_ended_by_a_fault_that_ends_motions(
    state: str, step: str, fault: str, is_over: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What cannot be recorded has not succeeded in any case."""
    plant = Plant(command=lambda *_: [], runs=tmp_path)
    monkeypatch.setattr(Plant, "state_of", lambda _self, _id: {"state": state, "step": step})
    chaos = Chaos(plant, ChaosOptions(), arm="arm", devices=())
    assert chaos._is_over("a task", next(one for one in FAULTS if one.name == fault)) is is_over


@pytest.mark.parametrize(
    ("state", "fault", "lasted_s", "may"),
    [
        ("succeeded", "silence client", LAPSED_S - 0.1, True),
        ("succeeded", "silence client", LAPSED_S + 0.1, False),
        ("cancelled", "silence client", 9.0, True),
        ("succeeded", "kill cell", 0.1, False),
        ("failed", "kill cell", 0.1, True),
    ],
)
def test_a_task_may_succeed_as_long_as_the_lease_of_a_silent_client_holds(
    state: str, fault: str, lasted_s: float, may: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant = Plant(command=lambda *_: [], runs=tmp_path)
    monkeypatch.setattr(Plant, "state_of", lambda _self, _id: {"state": state, "step": ""})
    chaos = Chaos(plant, ChaosOptions(), arm="arm", devices=())
    assert chaos._may_have_ended("a task", next(one for one in FAULTS if one.name == fault), lasted_s) is may


def test_every_fault_has_a_name_of_its_own_and_can_be_chosen() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(set(names)) == len(names)
    assert [fault.name for fault in ChaosOptions(faults=("fill disk",)).chosen()] == ["fill disk"]
    assert ChaosOptions().chosen() == FAULTS
