"""Tests of the alarms over HTTP and on the command line, from a stored reading to the journal."""

from __future__ import annotations

import time
from collections.abc import Iterator

import httpx2
import pytest
from typer.testing import CliRunner

from service.cli import _app
from service.serve import Panelwright
from tests.service.history.test_store import reading

LAMP = "pump_lamp.state"


@pytest.fixture(autouse=True)
def _lamp_is_off(served: Panelwright, client: httpx2.Client) -> Iterator[None]:
    """Begin each test with the alarm unacknowledged, and end it with the alarm normal."""
    desk = served.service.plant.alarms
    desk.take([reading(0, None, object="pump_lamp", kind="lamp", state="off", unit="")])
    yield
    desk.take([reading(0, None, object="pump_lamp", kind="lamp", state="on", unit="")])
    if desk.get(LAMP).state == "returned-unacknowledged":
        desk.acknowledge(LAMP, by="cleaner")
    assert desk.get(LAMP).state == "normal"


def test_an_alarm_is_listed_acknowledged_and_recorded(client: httpx2.Client, served: Panelwright) -> None:
    (alarm,) = client.get("/v1/alarms").json()["alarms"]
    assert (alarm["id"], alarm["state"], alarm["what_to_do"]) == (LAMP, "unacknowledged", "start the pump")
    assert alarm["says"] == "pump_lamp is off, which is not normal (on)"
    done = client.post(f"/v1/alarms/{LAMP}/acknowledge", json={"by": "alice", "reason": "on my way"})
    assert done.json()["state"] == "acknowledged"
    again = client.post(f"/v1/alarms/{LAMP}/acknowledge", json={"by": "alice"})
    assert (again.status_code, again.json()["hint"]) == (409, "only an unacknowledged alarm can be")
    newest = served.service.journal.records(kinds=("alarm",))[-1].data
    assert (newest["by"], newest["reason"], newest["before"]) == ("alice", "on my way", "unacknowledged")
    names = {alarm["id"] for alarm in client.get("/v1/alarms?all=true").json()["alarms"]}
    assert names == {LAMP, "pump_lamp.refused"}


def test_a_comment_is_recorded_and_leaves_the_state(client: httpx2.Client, served: Panelwright) -> None:
    said = client.post(f"/v1/alarms/{LAMP}/comment", json={"by": "alice", "reason": "a lamp is ordered"}).json()
    assert (said["state"], said["is_active"], said["by"]) == ("unacknowledged", True, "alice")
    newest = served.service.journal.records(kinds=("alarm",))[-1].data
    assert (newest["before"], newest["state"], newest["reason"]) == (
        "unacknowledged",
        "unacknowledged",
        "a lamp is ordered",
    )
    assert client.post(f"/v1/alarms/{LAMP}/comment", json={"by": "alice", "reason": ""}).status_code == 422


def test_an_alarm_is_shelved_and_taken_out_of_service(client: httpx2.Client) -> None:
    body = {"by": "alice", "reason": "repair"}
    shelved = client.post(f"/v1/alarms/{LAMP}/shelve", json={**body, "until_s": time.time() + 60}).json()
    assert (shelved["state"], shelved["is_active"]) == ("shelved", True)
    assert client.post(f"/v1/alarms/{LAMP}/unshelve", json={"by": "bob"}).json()["state"] == "unacknowledged"
    assert client.post(f"/v1/alarms/{LAMP}/out-of-service", json=body).json()["state"] == "out-of-service"
    assert client.post(f"/v1/alarms/{LAMP}/in-service", json={"by": "bob"}).json()["state"] == "unacknowledged"


@pytest.mark.parametrize(
    ("path", "body", "status"),
    [
        ("pump_lamp.high/acknowledge", {"by": "alice"}, 404),
        (f"{LAMP}/acknowledge", {}, 422),
        (f"{LAMP}/acknowledge", {"by": "al\u0007ice"}, 422),
        (f"{LAMP}/shelve", {"by": "alice", "until_s": 5.0, "reason": "x"}, 422),
        (f"{LAMP}/shelve", {"by": "alice", "until_s": 1.8e9}, 422),
        ("Pump/acknowledge", {"by": "alice"}, 422),
    ],
)
def test_what_cannot_be_meant_changes_nothing(
    client: httpx2.Client, path: str, body: dict[str, object], status: int
) -> None:
    assert client.post(f"/v1/alarms/{path}", json=body).status_code == status
    assert client.get("/v1/alarms").json()["alarms"][0]["state"] == "unacknowledged"


def test_the_command_lists_acknowledges_and_shelves(served: Panelwright) -> None:
    def run(*words: str) -> str:
        done = CliRunner().invoke(_app(), ["alarms", *words, "--url", served.url])
        assert done.exit_code == 0, (done.output, done.exception)
        return done.output

    assert "start the pump" in run()
    assert run("shelve", LAMP, "--for", "1h", "--reason", "test", "--by", "alice") == f"{LAMP} is shelved\n"
    assert "shelved" in run("--all")
    assert "is unacknowledged" in run("unshelve", LAMP)
    assert "is acknowledged" in run("acknowledge", LAMP, "--by", "alice")
    assert "is acknowledged" in run("comment", LAMP, "--reason", "a lamp is ordered", "--by", "alice")
