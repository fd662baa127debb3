"""While another client holds the lease, a motion and a reset are refused and leave nothing behind."""

from __future__ import annotations

import httpx2

from service.serve import Panelwright


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
