"""People who come near make the arm slow, and a stop holds or switches off: over HTTP, whoever has the lease."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx2
import pytest

from hal.errors import MotionRefused
from service.errors import JournalError
from service.http.state import AppState
from service.processes.latch import Latch
from service.processes.speed_desk import SpeedDesk
from service.serve import Panelwright
from tests.service.waiting import eventually


def rows(served: Panelwright, kind: str) -> list[dict[str, Any]]:
    return [record.data for record in served.service.journal.records(kinds=(kind,))]


def test_anybody_makes_the_arm_slow_and_the_holder_of_the_lease_restores_the_speed(
    client: httpx2.Client, served: Panelwright
) -> None:
    token = {"Lease-Token": client.post("/v1/lease", json={"holder": "alice"}).json()["token"]}
    assert client.get("/v1/speed").json() == {"is_reduced": False, "limit_m_per_s": 0.25}
    assert client.post("/v1/speed/reduce").json() == {"is_reduced": True, "limit_m_per_s": 0.1}
    assert served.service.supervisor.latch.is_reduced(), "the control thread reads it there"
    assert client.post("/v1/speed/restore").status_code == 409
    assert client.get("/v1/speed").json()["is_reduced"]
    assert client.post("/v1/speed/restore", headers=token).json()["is_reduced"] is False
    assert not served.service.supervisor.latch.is_reduced()
    client.post("/v1/lease/release", headers=token)
    assert "POST /v1/speed/reduce from 127.0.0.1" in rows(served, "speed-reduced")[-1]["source"]
    assert "alice" in rows(served, "speed-restored")[-1]["source"]


class Book:
    """What is recorded; `error` is raised instead."""

    def __init__(self) -> None:
        self.kinds: list[str] = []
        self.error: Exception | None = None
        self.meanwhile: Callable[[], None] = lambda: None

    def commit(self, kind: str, _data: dict[str, Any]) -> None:
        if self.error is not None:
            raise self.error
        self.kinds.append(kind)
        self.meanwhile()


def test_a_reduced_speed_outlives_the_service_and_a_full_disk_leaves_the_arm_slow(tmp_path: Path) -> None:
    book, path = Book(), tmp_path / "reduced-speed"
    with Latch.create(tmp_path / "latch") as latch:
        assert not SpeedDesk(latch, path, book.commit).is_reduced
        SpeedDesk(latch, path, book.commit).reduce("a person")
    with Latch.create(tmp_path / "latch") as latch:
        desk = SpeedDesk(latch, path, book.commit)
        assert desk.is_reduced and latch.is_reduced()
        book.error = JournalError("the disk is full", hint="free some space")
        with pytest.raises(JournalError):
            desk.restore("a person")
        assert desk.is_reduced
        book.error = None
        desk.restore("a person")
        assert not desk.is_reduced and not SpeedDesk(latch, path, book.commit).is_reduced
        book.error = JournalError("the disk is full", hint="free some space")
        with pytest.raises(JournalError):
            desk.reduce("a person")
        assert desk.is_reduced


def test_who_comes_near_while_the_speed_is_being_restored_is_not_overlooked(tmp_path: Path) -> None:
    book = Book()
    with Latch.create(tmp_path / "latch") as latch:
        desk = SpeedDesk(latch, tmp_path / "reduced-speed", book.commit)
        desk.reduce("a person")
        coming = threading.Thread(target=lambda: desk.reduce("another person"))

        def come() -> None:
            if not coming.is_alive() and coming.ident is None:
                coming.start()
                eventually(lambda: desk._asked == 2)

        book.meanwhile = come
        with pytest.raises(MotionRefused, match="reduced again"):
            desk.restore("the first person")
        coming.join(10.0)
        assert desk.is_reduced


@pytest.mark.parametrize("port", ["main", "stop"])
def test_a_stop_that_holds_becomes_one_that_switches_off_and_never_the_other_way(
    client: httpx2.Client, served: Panelwright, port: str
) -> None:
    url = f"{served.url}/v1/stop" if port == "main" else served.stop_url
    levels = []
    for level in ("hold", "hold", "sideways", "hold"):
        answer = httpx2.post(f"{url}?level={level}", trust_env=False).json()
        assert answer["is_latched"]
        levels.append(answer["level"])
    assert levels == ["hold", "hold", "off", "off"]
    eventually(lambda: rows(served, "stop")[-1]["level"] == "off")
    count = client.get("/v1/stop").json()["count"]
    assert client.post("/v1/stop/reset", json={"seen_count": count}).status_code == 200
    assert httpx2.post(url, trust_env=False).json()["level"] == "off", "without a level it switches off"


def test_a_device_that_does_not_obey_the_stop_is_named(
    client: httpx2.Client, served: Panelwright, monkeypatch: pytest.MonkeyPatch
) -> None:
    port: Any = served.service.supervisor.connection.mover
    assert client.post("/v1/stop").json()["not_stopped"] == []
    monkeypatch.setattr(port, "not_stopped", lambda **_given: ("gripper: it is silent",))
    assert client.get("/v1/stop").json()["not_stopped"] == ["gripper: it is silent"]


def test_a_stop_whose_caller_is_cancelled_while_it_waits_is_made_all_the_same() -> None:
    busy, stopped = threading.Event(), threading.Event()

    async def scene() -> None:
        unused: Any = None
        state = AppState(service=unused, stop_url="", hub=unused, metrics=unused, readings=unused)
        before = [asyncio.create_task(state.stop(lambda: busy.wait(10.0))) for _ in range(2)]
        mine = asyncio.create_task(state.stop(stopped.set))
        await asyncio.sleep(0)  # all of them are begun, and `mine` waits for a thread
        mine.cancel()
        busy.set()
        await asyncio.gather(*before)
        with pytest.raises(asyncio.CancelledError):
            await mine
        assert await asyncio.to_thread(stopped.wait, 10.0)

    asyncio.run(scene())
