"""Without a record nothing moves: a service whose disk is full or whose journal is deleted latches the stop and says so."""

from __future__ import annotations

import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2
import pytest

from service.errors import JournalError
from service.tasks.journal import LOST, Journal
from service.tasks.journal_reader import read_records, verify_chain
from service.tasks.journal_watch import JournalWatch
from tests.service.conftest import WriteCell
from tests.service.waiting import eventually

SERVICE = """
import sys, threading
from pathlib import Path
from hal.config import load_cell
from service.serve import Options, Panelwright
from tests.service.verbs import OPERATIONS
options = Options(port=0, runs_dir=Path(sys.argv[2]), warm=False)
panelwright = Panelwright(load_cell(Path(sys.argv[1])), options, operations=OPERATIONS)
panelwright.start()
print(panelwright.url, flush=True)
sys.stdin.read()
panelwright.close()
"""


@dataclass(frozen=True, slots=True)
class Served:
    """A service in processes of its own."""

    http: httpx2.Client
    pid: int
    runs: Path

    def get(self, path: str) -> Any:
        return self.http.get(path).json()

    def reset(self) -> httpx2.Response:
        return self.http.post("/v1/stop/reset", json={"seen_count": self.get("/v1/stop")["count"]})

    def is_stopped_by(self, text: str) -> bool:
        state = self.get("/v1/stop")
        return state["is_latched"] and text in state["source"]


@pytest.fixture(scope="module")
def served(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    runs = tmp_path_factory.mktemp("recorded") / "runs"
    command = [sys.executable, "-P", "-c", SERVICE, str(write_module_cell(robot=True)), str(runs)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdin is not None
        url = process.stdout.readline().strip()
        with httpx2.Client(base_url=url, timeout=30.0, trust_env=False) as http:
            yield Served(http, process.pid, runs)
        process.stdin.close()
        process.wait(60.0)


def test_on_a_full_disk_the_motion_ends_nothing_is_acknowledged_and_the_stop_works(served: Served) -> None:
    task = served.http.post("/v1/hold", json={"seconds": 1e6}).json()["id"]
    eventually(lambda: served.get(f"/v1/tasks/{task}")["state"] == "running")
    _, most = resource.prlimit(served.pid, resource.RLIMIT_FSIZE)
    resource.prlimit(served.pid, resource.RLIMIT_FSIZE, (0, most))  # every write to a file fails from now on
    try:
        eventually(lambda: served.is_stopped_by("the journal"))
        assert eventually(lambda: served.get("/readyz")["journal_problem"])
        assert eventually(lambda: served.get(f"/v1/tasks/{task}")["ended_s"])
        assert served.get(f"/v1/tasks/{task}")["state"] != "succeeded"
        assert served.http.post("/v1/lease", json={"holder": "alice"}).status_code == 503
        assert served.reset().status_code == 503
        assert served.http.post("/v1/echo", json={}).status_code == 503
        assert served.http.post("/v1/hold", json={"seconds": 0.1}).status_code == 409
        assert served.http.post("/v1/stop").json()["is_latched"]
    finally:
        resource.prlimit(served.pid, resource.RLIMIT_FSIZE, (most, most))
    eventually(lambda: served.get("/readyz")["journal_problem"] is None)
    assert served.get("/v1/stop")["is_latched"], "nothing moves again by itself"
    assert served.reset().status_code == 200
    assert served.http.post("/v1/hold?wait_s=20", json={"seconds": 0.1}).json()["state"] == "succeeded"
    assert verify_chain(served.runs / ".service" / "journal.sqlite") > 0


def test_a_deleted_folder_ends_the_permission_to_move_and_a_new_journal_says_so(served: Served) -> None:
    before = read_records(served.runs / ".service" / "journal.sqlite")[-1]
    deleted = served.runs.rename(served.runs.with_name("deleted"))  # in which the service makes no further file
    shutil.rmtree(deleted)
    eventually(lambda: served.is_stopped_by("deleted"))
    eventually(lambda: served.get("/readyz")["journal_problem"] is None)
    assert served.reset().status_code == 200
    assert served.http.post("/v1/hold?wait_s=20", json={"seconds": 0.1}).json()["state"] == "succeeded"
    journal = served.runs / ".service" / "journal.sqlite"
    first = read_records(journal)[0]
    assert (first.kind, first.data["last"]["id"] >= before.id) == (LOST, True)
    assert verify_chain(journal) > 1


@pytest.mark.parametrize("name", ["journal.sqlite", "journal.sqlite-wal", "journal.key"])
def test_an_entry_is_not_acknowledged_when_it_would_be_in_no_file(tmp_path: Path, name: str) -> None:
    journal = Journal(tmp_path / "journal.sqlite")
    journal.append("stop", {})
    (tmp_path / name).unlink()
    with pytest.raises(JournalError, match="deleted"):
        journal.append("stop-reset", {})
    eventually(lambda: journal.losses == 1)
    journal.append("stop-reset", {})
    journal.close()
    assert read_records(tmp_path / "journal.sqlite")[-1].kind == "stop-reset"


def test_the_watch_names_what_keeps_the_journal_from_recording(tmp_path: Path) -> None:
    told: list[str] = []
    journal = Journal(tmp_path / "journal.sqlite")
    watch = JournalWatch(journal, told.append)
    watch.look()
    assert watch.problem is None
    (tmp_path / "journal.probe").mkdir()
    watch.look()
    assert "takes no data" in str(watch.problem)
    (tmp_path / "journal.probe").rmdir()
    watch.look()
    assert (watch.problem, len(told)) == (None, 1)
    journal.close()
