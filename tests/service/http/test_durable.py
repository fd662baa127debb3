"""A change of state is acknowledged only when its record is on disk."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest

from service.errors import JournalError
from service.http.permissions import TABLE
from service.knowledge.store import KnowledgeStore
from service.operations import OPERATIONS
from service.serve import Panelwright
from tests.service.conftest import PANEL
from tests.service.history.test_store import reading

PNG = bytes(cv2.imencode(".png", np.full((64, 64), 128, np.uint8))[1])
Ask = Callable[[], httpx2.Response]
SWAP = {"driver": "fake:proximity", "options": {}}
ALARM = "/v1/alarms/pump_lamp.state"
EVENING = {"name": "evening", "mission": "inspect", "cron": "0 18 * * *", "zone": "Europe/Vienna"}
MISSION = 'title = "Look"\n[[steps]]\nkind = "inspect"\nname = "read"\nobjects = ["pump_lamp"]\n'


def image(http: httpx2.Client) -> str:
    return str(http.post("/v1/images", content=PNG, headers={"Content-Type": "image/png"}).json()["id"])


def token(http: httpx2.Client) -> dict[str, str]:
    return {"Lease-Token": http.post("/v1/lease", json={"holder": "alice"}).json()["token"]}


def sent(method: str, path: str, **body: Any) -> Callable[[httpx2.Client], Ask]:
    """Return a change that one request makes, without anything before it."""
    return lambda http: lambda: http.request(method, path, **body)


def released(http: httpx2.Client) -> Ask:
    headers = token(http)
    return lambda: http.post("/v1/lease/release", headers=headers)


def taken_over(http: httpx2.Client) -> Ask:
    token(http)
    return lambda: http.post("/v1/lease/take-over", json={"holder": "bob", "reason": "a test"})


def image_deleted(http: httpx2.Client) -> Ask:
    name = image(http)
    return lambda: http.delete(f"/v1/images/{name}")


def reset(http: httpx2.Client) -> Ask:
    count = http.post("/v1/stop").json()["count"]
    return lambda: http.post("/v1/stop/reset", json={"seen_count": count})


def restored(http: httpx2.Client) -> Ask:
    http.post("/v1/speed/reduce")
    return lambda: http.post("/v1/speed/restore")


def round_removed(http: httpx2.Client) -> Ask:
    assert http.put("/v1/rounds/evening", json=EVENING).status_code == 204
    return lambda: http.delete("/v1/rounds/evening")


def alarm(deed: str, *before: str) -> Callable[[httpx2.Client], Ask]:
    """Return the change of an alarm that has had other changes before."""
    body = {"by": "alice", "reason": "a test"}

    def sent(http: httpx2.Client, deed: str) -> httpx2.Response:
        until = {"until_s": time.time() + 60.0} if deed == "shelve" else {}
        return http.post(f"{ALARM}/{deed}", json={**body, **until})

    def prepared(http: httpx2.Client) -> Ask:
        assert all(sent(http, one).is_success for one in before)
        return lambda: sent(http, deed)

    return prepared


def reviewed(http: httpx2.Client) -> Ask:
    number = http.get("/v1/review").json()["readings"][0]["reading"]["id"]
    return lambda: http.post(f"/v1/review/{number}", json={"by": "alice", "verdict": "right", "reason": "seen"})


# Each call that changes something, with the last row that it records.
CHANGES: dict[str, tuple[str, Callable[[httpx2.Client], Ask]]] = {
    "POST /v1/images": (
        "image-stored", sent("POST", "/v1/images", content=PNG, headers={"Content-Type": "image/png"}),
    ),
    "DELETE /v1/images/{image_id}": ("image-deleted", image_deleted),
    "DELETE /v1/knowledge/{group}/{name}": ("knowledge-forgotten", sent("DELETE", "/v1/knowledge/panels/spare")),
    "DELETE /v1/calibrations/{name}": ("calibration-forgotten", sent("DELETE", "/v1/calibrations/wrist_camera")),
    "POST /v1/devices/{name}/fault": (
        "fault-injected", sent("POST", "/v1/devices/wrist_camera/fault", json={"fault": None}),
    ),
    "PUT /v1/devices/{name}": ("device-swapped", sent("PUT", "/v1/devices/finger_proximity", json=SWAP)),
    "POST /v1/devices/{name}/connect": ("device-swapped", sent("POST", "/v1/devices/finger_proximity/connect")),
    "POST /v1/lease": ("lease-acquired", sent("POST", "/v1/lease", json={"holder": "alice"})),
    "POST /v1/lease/release": ("lease-released", released),
    "POST /v1/lease/take-over": ("lease-taken-over", taken_over),
    "POST /v1/stop/reset": ("stop-reset", reset),
    "POST /v1/speed/reduce": ("speed-reduced", sent("POST", "/v1/speed/reduce")),
    "POST /v1/speed/restore": ("speed-restored", restored),
    "PUT /v1/rounds/{round}": ("round-defined", sent("PUT", "/v1/rounds/evening", json=EVENING)),
    "DELETE /v1/rounds/{round}": ("round-removed", round_removed),
    "DELETE /v1/limits/{object}": ("limits-set", sent("DELETE", "/v1/limits/pump_lamp")),
    "PUT /v1/mission-files/{mission}": (
        "mission-stored", sent("PUT", "/v1/mission-files/look", json={"text": MISSION, "replaces": None}),
    ),
    "POST /v1/alarms/{alarm}/acknowledge": ("alarm", alarm("acknowledge")),
    "POST /v1/alarms/{alarm}/comment": ("alarm", alarm("comment")),
    "POST /v1/alarms/{alarm}/shelve": ("alarm", alarm("shelve")),
    "POST /v1/alarms/{alarm}/unshelve": ("alarm", alarm("unshelve", "shelve")),
    "POST /v1/alarms/{alarm}/out-of-service": ("alarm", alarm("out-of-service")),
    "POST /v1/alarms/{alarm}/in-service": ("alarm", alarm("in-service", "out-of-service")),
    "POST /v1/review/{reading}": ("review", reviewed),
    "POST /v1/stop": ("stop", sent("POST", "/v1/stop")),
}  # fmt: skip
OTHERS = {
    "POST /v1/session", "DELETE /v1/session",  # about the caller alone, and gone with the service
    "POST /v1/lease/heartbeat",  # a lease does not outlive the service
    "POST /v1/tasks/{task_id}/cancel",  # the end of its task is recorded; a task that was cut off is not taken up
    "POST /v1/tasks/{task_id}/pause", "POST /v1/tasks/{task_id}/go-on",  # tests/service/tasks/test_between_motions.py
    "POST /v1/knowledge/outline", "POST /v1/read", "POST /v1/read-photograph", "POST /v1/mission-files/check",  # change nothing
    "PUT /v1/limits/{object}",  # as DELETE; the lamp of these tests has no limits that could be set
    "POST /v1/knowledge/teach",  # tests/service/http/test_knowledge.py
    "POST /v1/review/{reading}/teach",  # tests/service/review/test_review.py
    *(f"POST /v1/{verb}" for verb in (*OPERATIONS, "judge")),  # tasks: tests/service/tasks/test_tasks.py
}  # fmt: skip


@pytest.fixture(autouse=True)
def _something_to_change(client: httpx2.Client, served: Panelwright) -> Iterator[None]:
    service = served.service
    KnowledgeStore.of_runs(service.runs_dir, service.cell).write_panel("spare", PANEL)
    service.calibrations.write(service.cell.calibrations["wrist_camera"])
    guess = json.dumps({"held": {"state": "on"}, "possible": []})
    lamp = reading(0, None, object="pump_lamp", kind="lamp", state="off", unit="", guess=guess, doubt="glare")
    service.plant.history.add([lamp])
    service.plant.alarms.take([replace(lamp, doubt="")])
    yield
    for change in ("unshelve", "in-service"):
        client.post(f"{ALARM}/{change}", json={"by": "cleaner"})
    client.delete("/v1/rounds/evening")
    client.post("/v1/speed/restore")
    (served.service.cell.path.parent / "missions" / "look.toml").unlink(missing_ok=True)


def test_each_call_that_changes_something_is_here_or_says_why_not() -> None:
    writing = {call for call in TABLE if not call.startswith(("GET ", "WS "))}
    assert writing == {*CHANGES, *OTHERS} and not {*CHANGES} & OTHERS


@pytest.mark.parametrize("call", CHANGES)
def test_the_record_of_a_change_is_on_disk_with_its_acknowledgement(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    kind, prepared = CHANGES[call]
    ask = prepared(client)
    kept: list[str] = []
    append = served.service.journal.append

    def noted(name: str, data: dict[str, Any], **more: Any) -> None:
        append(name, data, **more)
        kept.append(name)

    monkeypatch.setattr(served.service.journal, "append", noted)
    answer = ask()
    assert answer.is_success, answer.text
    assert kept[-1] == kind


@pytest.mark.parametrize("call", CHANGES)
def test_a_change_without_a_record_is_not_acknowledged_except_the_stop(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    ask = CHANGES[call][1](client)

    def full(_kind: str, _data: dict[str, Any], **_more: Any) -> None:
        raise JournalError("the disk is full", hint="free space")

    monkeypatch.setattr(served.service.journal, "append", full)
    answer = ask()
    if call == "POST /v1/stop":
        assert answer.json()["is_latched"]
    else:
        assert (answer.status_code, answer.json()["type"]) == (503, "urn:panelwright:journal-error")
    monkeypatch.undo()
