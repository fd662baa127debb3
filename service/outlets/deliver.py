"""Delivers the changes of a cell to one outlet: in order, each at least once, from where the last gateway ended."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Protocol

from hal.errors import CellError
from service.outlets.source import Changes, Kept, Source

WAIT_S = 20.0
PAUSES_S = (1.0, 2.0, 5.0, 10.0, 30.0)
Sleep = Callable[[float], Awaitable[None]]
log = logging.getLogger(__name__)


class Backoff:
    """Pauses between tries, which become longer up to 30 s.

    Args:
        sleep: waits.
    """

    def __init__(self, sleep: Sleep = asyncio.sleep) -> None:
        self._sleep, self._failures = sleep, 0

    def worked(self) -> None:
        """Begin again with the shortest pause."""
        self._failures = 0

    async def pause(self) -> None:
        """Wait before the next try."""
        pause_s = PAUSES_S[min(self._failures, len(PAUSES_S) - 1)]
        self._failures += 1
        await self._sleep(pause_s)


async def batches(
    source: Source, kept: Kept, *, on_silence: Callable[[bool], Awaitable[None]], sleep: Sleep = asyncio.sleep
) -> AsyncIterator[Changes]:
    """Yield changes for ever; the cursor is saved when the next batch is asked for, so after a batch was delivered.

    The history of the service is the buffer while the far side is away: nothing else is kept.

    Args:
        on_silence: told when the service falls silent (True), and when it answers again.
    """
    backoff, is_silent = Backoff(sleep), False
    cursor = kept.load()
    while True:
        try:
            found = await source.changes(cursor, wait_s=0.0 if is_silent else WAIT_S)  # an answer ends the silence
        except CellError as error:
            if not is_silent:
                log.warning("%s", error.what)
                is_silent = True
                await on_silence(True)
            await backoff.pause()
            continue
        backoff.worked()
        if is_silent:
            is_silent = False
            await on_silence(False)
        yield found
        if found.cursor != cursor:
            cursor = found.cursor
            kept.save(cursor)


class Login(Protocol):
    """A section with a user."""

    @property
    def password_file(self) -> str | None:
        """File with the user's password."""
        ...


def password_of(section: Login) -> str | None:
    """Return the password in the section's file; None without one."""
    return secret_in(section.password_file)


def secret_in(file: str | None) -> str | None:
    """Return the text of a file without the space around it; None without a file."""
    return None if file is None else Path(file).read_text(encoding="utf-8").strip()
