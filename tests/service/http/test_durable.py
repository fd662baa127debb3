"""A change of state is acknowledged only when its record is on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest

from service.errors import JournalError
from service.knowledge.store import KnowledgeStore
from service.serve import Panelwright
from tests.service.conftest import PANEL

PNG = bytes(cv2.imencode(".png", np.full((64, 64), 128, np.uint8))[1])
Ask = Callable[[httpx2.Client], httpx2.Response]
SWAP = {"driver": "fake:proximity", "options": {}}


def stored(client: httpx2.Client) -> str:
    answer = client.post("/v1/images", content=PNG, headers={"Content-Type": "image/png"})
    return str(answer.json()["id"]) if answer.status_code == 201 else "none"


CHANGES: dict[str, Ask] = {
    "image-stored": lambda http: http.post("/v1/images", content=PNG, headers={"Content-Type": "image/png"}),
    "image-deleted": lambda http: http.delete(f"/v1/images/{stored(http)}"),
    "knowledge-forgotten": lambda http: http.delete("/v1/knowledge/panels/spare"),
    "calibration-forgotten": lambda http: http.delete("/v1/calibrations/wrist_camera"),
    "fault-injected": lambda http: http.post("/v1/devices/wrist_camera/fault", json={"fault": None}),
    "device-swapped": lambda http: http.put("/v1/devices/finger_proximity", json=SWAP),
    "lease-acquired": lambda http: http.post("/v1/lease", json={"holder": "alice"}),
}


@pytest.fixture(autouse=True)
def _something_to_forget(client: httpx2.Client, served: Panelwright) -> None:
    service = served.service
    KnowledgeStore.of_runs(service.runs_dir, service.cell).write_panel("spare", PANEL)
    service.calibrations.write(service.cell.calibrations["wrist_camera"])


@pytest.mark.parametrize("kind", CHANGES)
def test_the_record_of_a_change_is_on_disk_with_its_acknowledgement(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    kept: list[str] = []
    append = served.service.journal.append

    def noted(name: str, data: dict[str, Any], **more: Any) -> None:
        append(name, data, **more)
        kept.append(name)

    monkeypatch.setattr(served.service.journal, "append", noted)
    answer = CHANGES[kind](client)
    assert answer.is_success, answer.text
    assert kept[-1] == kind


@pytest.mark.parametrize("kind", CHANGES)
def test_a_change_without_a_record_is_not_acknowledged(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    image = stored(client)

    def full(_kind: str, _data: dict[str, Any], **_more: Any) -> None:
        raise JournalError("the disk is full", hint="free space")

    monkeypatch.setattr(served.service.journal, "append", full)
    answer = client.delete(f"/v1/images/{image}") if kind == "image-deleted" else CHANGES[kind](client)
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:panelwright:journal-error")
