"""The HTTP API as the source of outlets."""

from __future__ import annotations

import asyncio
import json
import ssl
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx2

from hal.errors import DeviceUnavailable
from service.client import ApiError, trusting_only
from service.outlets.source import CellState, Changes, Cursor, Deed, Instrument, instruments_of

TIMEOUT_S = 10.0
GATHER_S = 0.1  # between requests for changes: a busy service answers one for many readings and outlets


class ApiSource:
    """The source of outlets at a service; see `service.outlets.source.Source`.

    Args:
        url: its address.
        key: an observer's key, for a service that has keys.
        key_to_acknowledge: an operator's key, for a service that has keys.
        ca: certificate to trust, for an https address.
        transport: carries the requests; None for the network.
    """

    def __init__(
        self,
        url: str,
        *,
        key: str | None = None,
        key_to_acknowledge: str | None = None,
        ca: Path | None = None,
        transport: httpx2.AsyncBaseTransport | None = None,
    ) -> None:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        self._may_acknowledge = {} if key_to_acknowledge is None else {"Authorization": f"Bearer {key_to_acknowledge}"}
        verify: ssl.SSLContext | bool = True if ca is None else trusting_only(ca)
        self._asked: dict[tuple[Cursor, float], asyncio.Task[Changes]] = {}
        self._next_s = 0.0  # when the next request for changes may begin, on the event loop's clock
        self._http = httpx2.AsyncClient(
            base_url=url, headers=headers, timeout=TIMEOUT_S, trust_env=False, verify=verify, transport=transport
        )

    async def changes(self, cursor: Cursor, *, wait_s: float) -> Changes:
        """Return what came after a cursor; outlets that know equally much share one request."""
        asked = (cursor, wait_s)
        task = self._asked.get(asked)
        if task is None:
            task = self._asked[asked] = asyncio.create_task(self._changes(cursor, wait_s))
            task.add_done_callback(lambda _: self._asked.pop(asked))
        return await asyncio.shield(task)  # one that ends must not end the request of the others

    async def _changes(self, cursor: Cursor, wait_s: float) -> Changes:
        loop = asyncio.get_running_loop()
        await asyncio.sleep(self._next_s - loop.time())
        self._next_s = loop.time() + GATHER_S
        given = {"readings_after": cursor.reading, "alarms_after": cursor.alarm}
        asked = {key: value for key, value in given.items() if value is not None} | {"wait_s": wait_s}
        found = await self._get("/v1/feed", asked, timeout_s=wait_s + TIMEOUT_S)
        return Changes(
            readings=tuple(found["readings"]),
            alarms=tuple(found["alarms"]),
            cursor=Cursor(reading=found["readings_after"], alarm=found["alarms_after"]),
        )

    async def state(self) -> CellState:
        """Return the state of the cell."""
        history, alarms = await self._get("/v1/history"), await self._get("/v1/alarms", {"all": "true"})
        devices, ready = await self._get("/v1/devices"), await self._get("/readyz")
        return CellState(
            readings={one["object"]: one for one in history["newest"]},
            alarms={one["id"]: one for one in alarms["alarms"]},
            devices={one["name"]: one for one in devices["devices"]},
            is_ready=bool(ready.get("is_ready", False)),
        )

    async def panel(self) -> tuple[Instrument, ...]:
        """Return the objects of the panel."""
        return instruments_of(await self._get("/v1/panel"))

    async def act(self, alarm: str, deed: Deed, *, by: str, reason: str) -> None:
        """Acknowledge an alarm, or comment on it."""
        path = f"/v1/alarms/{quote(alarm, safe='')}/{deed}"
        try:
            answer = await self._http.post(path, json={"by": by, "reason": reason}, headers=self._may_acknowledge)
            found = json.loads(answer.content)
        except (httpx2.RequestError, ValueError) as error:
            raise DeviceUnavailable(f"the service does not answer: {error}", hint="see its log") from error
        if answer.status_code >= httpx2.codes.BAD_REQUEST:
            raise ApiError(found if isinstance(found, dict) else {})

    async def close(self) -> None:
        """Close its connections."""
        for task in self._asked.values():
            task.cancel()
        await self._http.aclose()

    async def _get(self, path: str, asked: dict[str, Any] | None = None, *, timeout_s: float = TIMEOUT_S) -> Any:
        try:
            answer = await self._http.get(path, params=asked, timeout=timeout_s)
            found = json.loads(answer.content)
        except (httpx2.RequestError, ValueError) as error:
            raise DeviceUnavailable(f"the service does not answer: {error}", hint="see its log") from error
        if answer.status_code >= httpx2.codes.BAD_REQUEST and path != "/readyz":
            raise ApiError(found if isinstance(found, dict) else {})
        return found
