"""`WS /v1/stream`: joints, wrench, contacts and frames many times per second, encoded once for all listeners."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Callable
from typing import Any

from fastapi import APIRouter, WebSocket, WebSocketDisconnect

from hal.errors import CellError
from hal.geometry import to_json
from hal.motion import RobotState
from service.access.keys import Role
from service.http.access import POLICY_VIOLATION, Caller, caller_with, check_role, is_valid_still
from service.http.state import AppState, socket_state
from service.jsonable import jsonable

router = APIRouter()
RATE_HZ = 20.0
FIRST_MESSAGE_S = 5.0  # a listener without a key in its header has this long to send one
MAX_CLIENTS = 100
log = logging.getLogger(__name__)


class Sampler:
    """Reads the state while there are listeners. A slow listener misses samples but never delays others."""

    def __init__(self, state: AppState) -> None:
        self._state = state
        self._listeners: set[asyncio.Queue[str]] = set()
        self._task: asyncio.Task[None] | None = None

    def join(self) -> asyncio.Queue[str]:
        """Return a mailbox that holds the newest sample."""
        mailbox: asyncio.Queue[str] = asyncio.Queue(maxsize=1)
        self._listeners.add(mailbox)
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._run())
        return mailbox

    def leave(self, mailbox: asyncio.Queue[str]) -> None:
        """Send no more samples to the mailbox."""
        self._listeners.discard(mailbox)

    def __len__(self) -> int:
        return len(self._listeners)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        next_s = loop.time()
        while self._listeners:
            next_s = max(next_s + 1.0 / RATE_HZ, loop.time())  # a late sample does not delay those after it
            text = await self._text()
            for mailbox in self._listeners:
                if mailbox.full():
                    mailbox.get_nowait()
                mailbox.put_nowait(text)
            await asyncio.sleep(max(0.0, next_s - loop.time()))

    async def _text(self) -> str:
        try:
            return await self._state.in_thread(lambda: json.dumps(self._sample()))
        except CellError as error:  # for example too many waiting reads: report it and continue
            return json.dumps({"problem": error.what})
        except Exception as error:  # a defect must not leave all listeners waiting endlessly
            log.exception("sampling the state")
            return json.dumps({"problem": f"the state cannot be read: {type(error).__name__}"})

    def _sample(self) -> dict[str, Any]:
        service = self._state.service
        sample: dict[str, Any] = {"is_latched": service.supervisor.latch.is_set()}
        try:
            sample |= _shown(service.supervisor.connection.mover.state())
        except CellError as error:
            sample["problem"] = error.what
        panel = service.world.base_from_panel
        sample["base_from_panel"] = to_json(panel.parent_from_child) if panel is not None else None
        return sample


def _shown(state: RobotState) -> dict[str, Any]:
    data: dict[str, Any] = jsonable(state)
    return data


@router.websocket("/v1/stream")
async def stream(socket: WebSocket) -> None:
    state = socket_state(socket)
    sampler: Sampler = socket.app.state.sampler
    if len(sampler) >= MAX_CLIENTS:
        await socket.close(1013, "too many listeners")
        return
    await socket.accept()
    caller: Caller | None = socket.state.caller or await _by_first_message(socket, state)
    if caller is None:
        return
    mailbox = sampler.join()
    watch = asyncio.create_task(_until_gone(socket))
    try:
        while not state.hub.is_closing and not watch.done():
            await _forward(socket, mailbox, lambda: is_valid_still(state, caller))
        await socket.close(1001)
    except (WebSocketDisconnect, RuntimeError):
        pass  # the listener has left
    finally:
        sampler.leave(mailbox)
        watch.cancel()


async def _by_first_message(socket: WebSocket, state: AppState) -> Caller | None:
    """Return whose key a listener's first message has, `{"key": "..."}`; close the socket and return None without one."""
    try:
        async with asyncio.timeout(FIRST_MESSAGE_S):
            message = await socket.receive_json()
        secret = message.get("key") if isinstance(message, dict) else None
        caller = caller_with(state.service.keys.now(), secret if isinstance(secret, str) else "")
        check_role(caller, Role.OBSERVER)
    except WebSocketDisconnect:
        return None
    except (CellError, TimeoutError, ValueError, KeyError):  # not JSON, or no text message
        await socket.close(1008, "this service needs a key, in the header or as the first message")
        return None
    return caller


async def _forward(socket: WebSocket, mailbox: asyncio.Queue[str], may: Callable[[], bool]) -> None:
    try:
        async with asyncio.timeout(0.5):
            text = await mailbox.get()
    except TimeoutError:
        return
    if not may():
        await socket.close(POLICY_VIOLATION, "the key of this listener is not valid any more")
        raise WebSocketDisconnect(POLICY_VIOLATION)
    await socket.send_text(text)


async def _until_gone(socket: WebSocket) -> None:
    """Read and discard the messages of a listener, to notice when it leaves."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass
