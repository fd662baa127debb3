"""While another client holds the lease, a motion and a reset are refused and leave nothing behind."""

from __future__ import annotations

import httpx2

from service.serve import Panelwright
from tests.service.waiting import eventually


def test_a_motion_without_the_lease_becomes_no_task(client: httpx2.Client, served: Panelwright) -> None:
    before = [task.id for task in served.service.tasks.all()]
    client.post("/v1/lease", json={"holder": "alice"})
    for headers in ({}, {"Lease-Token": "1.guess"}):
        assert client.post("/v1/hold", json={"seconds": 0.1}, headers=headers).status_code == 409
    assert [task.id for task in served.service.tasks.all()] == before


def test_only_the_holder_resets_the_stop(client: httpx2.Client, served: Panelwright) -> None:
    token = client.post("/v1/lease", json={"holder": "alice"}).json()["token"]
    seen = {"seen_count": client.post("/v1/stop").json()["count"]}
    for headers in ({}, {"Lease-Token": "1.guess"}):
        assert client.post("/v1/stop/reset", json=seen, headers=headers).status_code == 409
    assert served.service.supervisor.latch.is_set()
    assert client.post("/v1/stop/reset", json=seen, headers={"Lease-Token": token}).status_code == 200


def test_only_the_holder_pauses_and_a_stop_ends_the_pause(client: httpx2.Client, served: Panelwright) -> None:
    token = {"Lease-Token": client.post("/v1/lease", json={"holder": "alice"}).json()["token"]}
    task = client.post("/v1/hold", json={"seconds": 100.0}, headers=token).json()
    assert (task["can_pause"], task["pause"]) == (True, "no")
    path = f"/v1/tasks/{task['id']}"
    assert client.post(f"{path}/pause").status_code == 409
    assert client.post(f"{path}/pause", headers=token).json()["pause"] in ("asked", "held")

    def is_held() -> bool:
        client.post("/v1/lease/heartbeat", headers=token)
        return bool(client.get(path).json()["pause"] == "held")

    eventually(is_held)
    assert client.post(f"{path}/go-on").status_code == 409
    client.post("/v1/stop")
    ended = client.get(f"{path}?wait_s=10").json()
    assert (ended["state"], ended["pause"]) == ("failed", "no")
    kinds = [record.kind for record in served.service.journal.records(limit=20)]
    assert kinds.count("task-paused") == 1
