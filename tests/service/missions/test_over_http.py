"""Tests of mission files over HTTP: checked while they are written, stored in one step, and never over another's changes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from hal.config import load_cell
from service.missions.files import SHIPPED
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS

LOOK = 'title = "Look"\n# of the lamp\n[[steps]]\nkind = "inspect"\nname = "read"\nobjects = ["pump_lamp"]\n'
FAULTY = """
titel = "Look"
[[steps]]
kind = "inspect"
name = "read"
objects = ["pump_lampp"]
[[steps]]
kind = "feel"
name = "Feel it"
[[steps]]
kind = "set"
name = "light"
object = "pump_lamp"
state = "on"
"""


@pytest.fixture
def cell(write_cell: WriteCell, tmp_path: Path) -> Iterator[Panelwright]:
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True)
    panelwright = Panelwright(load_cell(write_cell(robot=True)), options, operations=OPERATIONS)
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture
def http(cell: Panelwright) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=cell.url, timeout=30.0, trust_env=False) as client:
        yield client


def put(http: httpx2.Client, text: str, replaces: str | None = None, name: str = "look") -> httpx2.Response:
    return http.put(f"/v1/mission-files/{name}", json={"text": text, "replaces": replaces})


def check(http: httpx2.Client, text: str, name: str = "look") -> Any:
    return http.post("/v1/mission-files/check", json={"text": text, "name": name}).json()


def test_a_mission_is_stored_as_a_file_of_the_cell_and_journaled(http: httpx2.Client, cell: Panelwright) -> None:
    assert put(http, LOOK).status_code == 204
    path = cell.service.cell.path.parent / "missions" / "look.toml"
    assert path.read_text() == LOOK
    shown = http.get("/v1/mission-files/look").json()
    assert (shown["text"], shown["is_shipped"]) == (LOOK, False)
    listed = {one["name"]: one for one in http.get("/v1/mission-files").json()["files"]}
    assert listed["look"]["title"] == "Look"
    changed = LOOK.replace('"Look"', '"Look again"')
    assert put(http, changed, shown["digest"]).status_code == 204
    records = cell.service.journal.records(kinds=("mission-stored",))
    assert [record.data["replaces"] for record in records] == [None, shown["digest"]]
    assert path.read_text() == changed
    assert [one.name for one in path.parent.iterdir()] == ["look.toml"]


def test_nobody_overwrites_the_changes_of_another(http: httpx2.Client, cell: Panelwright) -> None:
    assert put(http, LOOK).status_code == 204
    refused = put(http, LOOK + "# mine\n")
    assert (refused.status_code, "of that name" in refused.json()["detail"]) == (409, True)
    refused = put(http, LOOK + "# mine\n", "0" * 64)
    assert (refused.status_code, "changed by somebody else" in refused.json()["detail"]) == (409, True)
    assert http.get("/v1/mission-files/look").json()["text"] == LOOK
    assert len(cell.service.journal.records(kinds=("mission-stored",))) == 1


def test_all_faults_are_told_at_once_and_nothing_is_stored(http: httpx2.Client, cell: Panelwright) -> None:
    found = check(http, FAULTY)
    told = "\n".join(found["faults"])
    for words in (
        "titel: unknown key 'titel'; did you mean 'title'?",
        "steps.1.name: 'Feel it' is not written as it must be",
        "steps.0.objects.0: no object called 'pump_lampp' on panel 'fake'; did you mean 'pump_lamp'?",
        "steps.2.object: pump_lamp is a lamp, which cannot be operated",
    ):
        assert words in told
    refused = put(http, FAULTY)
    assert refused.status_code == 422
    assert refused.json()["details"]["faults"] == found["faults"]
    assert not (cell.service.cell.path.parent / "missions").exists()
    assert check(http, LOOK)["problem"] is None


@pytest.mark.parametrize("text", ["a = " + "[" * 5000, "a = " + "1" * 5000, "[[steps", "steps = 3", "\u0000", ""])
def test_text_that_is_no_mission_is_told_as_a_fault(http: httpx2.Client, text: str) -> None:
    assert check(http, text)["faults"]
    assert put(http, text).status_code == 422


def test_a_mission_that_would_call_itself_is_refused(http: httpx2.Client) -> None:
    assert put(http, LOOK).status_code == 204
    call = '[[steps]]\nkind = "call"\nname = "again"\nmission = "{}"\n'
    assert put(http, call.format("look"), name="caller").status_code == 204
    faults = check(http, call.format("caller"))["faults"]  # look calls caller, which calls look
    assert any("mission 'look' calls itself" in fault for fault in faults)


def test_a_shipped_mission_is_hidden_by_one_of_the_cell_and_never_changed(http: httpx2.Client) -> None:
    before = (SHIPPED / "inspect.toml").read_text()
    shown = http.get("/v1/mission-files/inspect").json()
    assert shown["is_shipped"] is True
    assert put(http, LOOK, shown["digest"], name="inspect").status_code == 204
    assert http.get("/v1/mission-files/inspect").json()["text"] == LOOK
    assert (SHIPPED / "inspect.toml").read_text() == before


def test_a_file_that_cannot_be_written_is_told_and_stays(http: httpx2.Client, cell: Panelwright) -> None:
    assert put(http, LOOK).status_code == 204
    folder = cell.service.cell.path.parent / "missions"
    (folder / "look.toml.new").mkdir()  # stands where the new text is written first
    digest = http.get("/v1/mission-files/look").json()["digest"]
    refused = put(http, LOOK + "# more\n", digest)
    assert (refused.status_code, refused.json()["type"]) == (503, "urn:panelwright:file-fault")
    assert (folder / "look.toml").read_text() == LOOK


@pytest.mark.parametrize("name", ["Look", "..%2fcell", "a" * 62, "look.toml"])
def test_a_name_that_is_no_mission_is_refused(http: httpx2.Client, name: str) -> None:
    assert put(http, LOOK, name=name).status_code in (404, 405, 422)
    assert http.get("/v1/mission-files/nothing").status_code == 404
