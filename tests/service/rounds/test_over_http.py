"""Tests of rounds over HTTP, on the command line, and on a running service with a lease and an alarm."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest
from typer.testing import CliRunner

from hal.config import load_cell
from hal.errors import ConfigError
from hal.plant import RoundSection
from service.cli import _app
from service.operations import Operation, OperationContext
from service.rounds.book import RoundBook
from service.rounds.cell import RunningCell
from service.rounds.keeper import RoundKeeper
from service.schema.mission_request import MissionRequest
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.history.test_store import reading
from tests.service.verbs import OPERATIONS, EchoResult

ROUND = '[[rounds]]\nname = "night"\ncron = "0 2 * * *"\nzone = "Europe/Vienna"\nforbidden_by = ["{alarm}"]'
EVENING = {"name": "evening", "mission": "inspect", "cron": "0 18 * * *", "zone": "Europe/Vienna"}


def read_all(context: OperationContext, request: MissionRequest) -> EchoResult:
    context.task.progress(0.5, "reading")
    return EchoResult(text=request.file or "", number=0.0, nothing=None)


MISSIONS = Operation(
    name="missions", request_model=MissionRequest, result_model=EchoResult, run=read_all, summary="Missions"
)


@pytest.fixture(scope="module")
def rounds(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    path = write_module_cell(robot=True, extra=ROUND.format(alarm="pump_lamp.state"))
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True)
    panelwright = Panelwright(load_cell(path), options, operations={**OPERATIONS, "missions": MISSIONS})
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture
def http(rounds: Panelwright) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=rounds.url, timeout=30.0, trust_env=False) as client:
        yield client


def test_rounds_are_added_listed_and_removed(http: httpx2.Client, rounds: Panelwright) -> None:
    assert http.put("/v1/rounds/evening", json=EVENING).status_code == 204
    found = {one["name"]: one for one in http.get("/v1/rounds").json()["rounds"]}
    assert {name: one["is_of_file"] for name, one in found.items()} == {"evening": False, "night": True}
    assert found["evening"]["next_s"] > time.time()
    assert http.delete("/v1/rounds/evening").status_code == 204
    assert http.delete("/v1/rounds/evening").status_code == 404
    assert http.delete("/v1/rounds/night").status_code == 409
    kinds = [record.kind for record in rounds.service.journal.records(kinds=("round-defined", "round-removed"))]
    assert kinds == ["round-defined", "round-removed"]


@pytest.mark.parametrize(
    ("path", "change", "told"),
    [
        ("evening", {"cron": "0 25 * * *"}, "its hour cannot be meant"),
        ("evening", {"zone": "Mars/Olympus"}, "no IANA time zone"),
        ("evening", {"mission": "inspekt"}, "did you mean 'inspect'"),
        ("evening", {"forbidden_by": ["pump_lamp.stat"]}, "pump_lamp.state"),
        ("morning", {}, "the path names 'morning'"),
    ],
)
def test_a_round_that_cannot_be_meant_is_refused(
    http: httpx2.Client, path: str, change: dict[str, object], told: str
) -> None:
    answer = http.put(f"/v1/rounds/{path}", json={**EVENING, **change})
    assert answer.status_code == 422
    assert told in answer.text
    assert [one["name"] for one in http.get("/v1/rounds").json()["rounds"]] == ["night"]


def test_a_cell_file_with_a_faulty_round_does_not_start(write_cell: WriteCell, tmp_path: Path) -> None:
    cell = load_cell(write_cell(robot=True, extra=ROUND.format(alarm="pump.state")))
    with pytest.raises(ConfigError, match=r"rounds\.0\.forbidden_by: there is no alarm 'pump\.state'"):
        Panelwright(cell, Options(port=0, runs_dir=tmp_path, inline=True), operations=OPERATIONS)


def test_a_round_waits_for_the_lease_and_for_its_alarm_and_runs_in_its_own_name(
    rounds: Panelwright, http: httpx2.Client, tmp_path: Path
) -> None:
    service, alarms = rounds.service, rounds.service.plant.alarms
    now = [1_790_000_000.0]
    cell = RunningCell(
        supervisor=service.supervisor,
        lease=service.lease,
        tasks=service.tasks,
        is_active=lambda alarm: alarms.get(alarm).is_active,
        submit=service._round,
    )
    section = RoundSection(name="hourly", cron="0 * * * *", forbidden_by=("pump_lamp.state",))
    keeper = RoundKeeper([section], book=RoundBook(tmp_path / "r.sqlite"), cell=cell, now_s=lambda: now[0])
    now[0] += 3600.0
    token = http.post("/v1/lease", json={"holder": "alice"}).json()["token"]
    keeper.tick()
    assert keeper.prospects()[0].waits_for == "alice holds the lease"
    http.post("/v1/lease/release", headers={"Lease-Token": token})
    alarms.take([reading(0, None, object="pump_lamp", kind="lamp", state="off", unit="")])
    keeper.tick()
    assert keeper.prospects()[0].waits_for == "alarm pump_lamp.state forbids it"
    alarms.take([reading(0, None, object="pump_lamp", kind="lamp", state="on", unit="")])
    keeper.tick()
    (run,) = keeper.runs()
    task = service.tasks.get(run.task or "")
    assert task.wait(30.0)
    assert (task.by, task.result["text"]) == ("round hourly", "inspect")
    keeper.tick()
    assert str(keeper.runs()[0].state) == "succeeded"


def test_the_command_adds_lists_and_removes(rounds: Panelwright) -> None:
    def run(*words: str) -> str:
        done = CliRunner().invoke(_app(), ["rounds", *words, "--url", rounds.url])
        assert done.exit_code == 0, (done.output, done.exception)
        return done.output

    assert run("add", "noon", "--cron", "0 12 * * *", "--zone", "Europe/Vienna") == "round noon is kept\n"
    assert "12:00" in run()
    assert "state" in run("runs", "noon")
    assert run("remove", "noon") == "round noon is removed\n"
