"""Webhook: each change as a signed request, tried again with growing pauses; what cannot be delivered is kept.

The signature is that of the time stamp, a dot and the body: `HMAC-SHA256(secret, f"{timestamp}.{body}")` in hexadecimal digits.
A receiver refuses old time stamps, and recognises a repeat by `X-Panelwright-Id`.
"""

from __future__ import annotations

import asyncio
import hashlib
import hmac
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx2

from hal.outlets import WebhookSection
from service.outlets.deliver import Backoff, Sleep, batches
from service.outlets.source import Changes, CursorFile, Source, told

TIMEOUT_S = 10.0
TRY_AGAIN = (408, 425, 429)  # of the statuses that blame the request
log = logging.getLogger(__name__)


class WebhookOutlet:
    """Sends the changes of a cell to an address.

    Args:
        secret: signs each request.
        dead_letters: file to which what cannot be delivered is appended, one JSON object a line.
        sleep, now_s: waits between tries, and tells the time since 1970.
        transport: carries the requests; None for the network.
    """

    def __init__(
        self,
        section: WebhookSection,
        *,
        cell: str,
        source: Source,
        cursor: CursorFile,
        secret: str,
        dead_letters: Path,
        sleep: Sleep = asyncio.sleep,
        now_s: Callable[[], float] = time.time,
        transport: httpx2.AsyncBaseTransport | None = None,
    ) -> None:
        self._section, self._cell, self._source, self._cursor = section, cell, source, cursor
        self._secret, self._dead_letters, self._sleep, self._now_s = secret.encode(), dead_letters, sleep, now_s
        self._http = httpx2.AsyncClient(timeout=TIMEOUT_S, transport=transport)

    async def run(self) -> None:
        """Send for ever."""

        async def on_silence(is_silent: bool) -> None:
            log.info("webhook: the service %s", "is silent" if is_silent else "answers again")

        async for found in batches(self._source, self._cursor, on_silence=on_silence, sleep=self._sleep):
            for number, event in self._events(found):
                await self._deliver(number, event)

    def _events(self, found: Changes) -> Iterator[tuple[str, Mapping[str, Any]]]:
        if "readings" in self._section.events:
            for one in found.readings:
                yield (
                    f"{self._cell}-reading-{one['id']}",
                    {"event": "reading", "cell": self._cell, "reading": told(one)},
                )
        if "alarms" in self._section.events:
            for one in found.alarms:
                yield f"{self._cell}-alarm-{one['number']}", {"event": "alarm", "cell": self._cell, "alarm": dict(one)}

    async def _deliver(self, number: str, event: Mapping[str, Any]) -> None:
        """Send one event; after too many tries, or when it is refused for good, it becomes a dead letter."""
        body, backoff, why = json.dumps(event), Backoff(self._sleep), ""
        for attempt in range(self._section.tries):
            if attempt:
                await backoff.pause()
            try:
                answer = await self._http.post(self._section.url, content=body, headers=self._headers(number, body))
            except httpx2.RequestError as error:
                why = str(error) or type(error).__name__
                continue
            if answer.is_success:
                return
            why = f"status {answer.status_code}"
            if 400 <= answer.status_code < 500 and answer.status_code not in TRY_AGAIN:
                break
        log.error("webhook: %s is not delivered: %s; it is kept in %s", number, why, self._dead_letters)
        self._dead_letters.parent.mkdir(parents=True, exist_ok=True)
        with self._dead_letters.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"id": number, "at_s": self._now_s(), "why": why, **event}) + "\n")

    def _headers(self, number: str, body: str) -> dict[str, str]:
        stamp = f"{self._now_s():.0f}"
        return {
            "Content-Type": "application/json",
            "X-Panelwright-Id": number,
            "X-Panelwright-Timestamp": stamp,
            "X-Panelwright-Signature": signature_of(self._secret, stamp, body),
        }


def signature_of(secret: bytes, stamp: str, body: str) -> str:
    """Return the signature of a request."""
    return "sha256=" + hmac.new(secret, f"{stamp}.{body}".encode(), hashlib.sha256).hexdigest()
