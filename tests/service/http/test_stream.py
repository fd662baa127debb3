"""The WebSocket stream sends many samples per second, encoded once for all, and no listener delays another."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Iterator
from typing import Any, cast

import httpx2
import pytest
from websockets.sync.client import ClientConnection, connect

from service.http.state import AppState
from service.http.stream import Sampler
from service.serve import Panelwright
from tests.service.waiting import eventually


@pytest.fixture
def socket(served: Panelwright, client: httpx2.Client) -> Iterator[ClientConnection]:
    with _join(served) as socket:
        yield socket


def _join(served: Panelwright) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{served.port}/v1/stream", proxy=None, open_timeout=20)


def _next(socket: ClientConnection) -> dict[str, object]:
    sample: dict[str, object] = json.loads(socket.recv(timeout=20), parse_constant=pytest.fail)
    return sample


def test_samples_tell_the_whole_state(socket: ClientConnection) -> None:
    sample = _next(socket)
    assert sample["position_rad"] == pytest.approx([0.0, -1.2, 1.6, 0.0, 0.8, 0.0])
    assert len(sample["wrench"]) == 6
    assert sample["is_latched"] is False
    assert sample["base_from_panel"] is None


def test_a_stop_shows_in_the_stream(socket: ClientConnection, client: httpx2.Client) -> None:
    client.post("/v1/stop")
    eventually(lambda: _next(socket)["is_latched"])


def test_an_arm_that_falls_silent_shows_in_the_stream(socket: ClientConnection, client: httpx2.Client) -> None:
    """The last joint state must not be shown as if it were new."""
    assert _next(socket)["faults"] == []
    client.post("/v1/devices/arm/fault", json={"fault": "silent"})
    eventually(lambda: _next(socket)["faults"] == ["arm: timeout"])
    client.post("/v1/devices/arm/fault", json={"fault": None})
    eventually(lambda: _next(socket)["faults"] == [])


def test_listeners_share_samples_and_a_sleeping_one_holds_nobody_up(served: Panelwright, client: httpx2.Client) -> None:
    with _join(served), _join(served) as awake, _join(served) as another:
        stamps = [_next(awake)["stamp_s"] for _ in range(10)]
        assert stamps == sorted(stamps)
        assert _next(another)["position_rad"] == _next(awake)["position_rad"]


def test_a_defect_below_is_told_to_listeners_and_does_not_end_the_stream() -> None:
    class Broken:
        async def in_thread(self, _work: Callable[[], Any]) -> Any:
            raise ZeroDivisionError

    told = json.loads(asyncio.run(Sampler(cast(AppState, Broken()))._text()))
    assert told == {"problem": "the state cannot be read: ZeroDivisionError"}


def test_what_a_listener_says_is_ignored(socket: ClientConnection) -> None:
    socket.send("move!")
    socket.send(b"\x00\xff")
    assert _next(socket)["is_moving"] is False


def test_watching_does_not_disturb_a_motion(socket: ClientConnection, client: httpx2.Client) -> None:
    """State reads and motions exclude each other in the controller; a watcher must never make a motion fail."""
    for _ in range(5):
        assert client.post("/v1/hold?wait_s=20", json={"seconds": 0.4}).json()["state"] == "succeeded"
        _next(socket)


def test_a_huge_message_ends_only_its_own_connection(served: Panelwright, client: httpx2.Client) -> None:
    with _join(served) as rude:
        rude.send("x" * 200_000)
        with pytest.raises(Exception, match=r"1009|too big"):
            for _ in range(200):
                rude.recv(timeout=20)
    assert client.get("/healthz").status_code == 200
