"""Wakes waiting requests in the event loop when a worker thread changes a task."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from service.tasks.model import Task
from service.tasks.store import TaskStore


class Hub:
    """One subscription to all tasks, shared by all waiting requests of the event loop."""

    def __init__(self) -> None:
        self._watchers: set[asyncio.Event] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._unsubscribe: Callable[[], None] = lambda: None
        self.is_closing = False
        self.on_close: list[Callable[[], None]] = []  # called from any thread

    def open(self, tasks: TaskStore) -> None:
        """Subscribe to the tasks; call it inside the event loop."""
        self._loop = asyncio.get_running_loop()
        self._unsubscribe = tasks.subscribe(self._changed)

    def close(self) -> None:
        """End every stream; may be called from any thread."""
        self.is_closing = True
        self._unsubscribe()
        self._call(self._wake)
        for tell in self.on_close:
            tell()

    @contextmanager
    def watch(self) -> Iterator[asyncio.Event]:
        """Yield an event that is set after each change; the watcher clears it before it checks the task."""
        event = asyncio.Event()
        self._watchers.add(event)
        try:
            yield event
        finally:
            self._watchers.discard(event)

    async def wait_for(self, task: Task, timeout_s: float) -> bool:
        """Wait until the task has ended, without blocking a thread; returns whether it has."""
        end_s = asyncio.get_running_loop().time() + timeout_s
        with self.watch() as changed:
            while not task.state.is_final and not self.is_closing:
                changed.clear()
                if task.state.is_final:
                    break
                try:
                    async with asyncio.timeout_at(end_s):
                        await changed.wait()
                except TimeoutError:
                    break
        return task.state.is_final

    def _changed(self, _task: Task) -> None:
        self._call(self._wake)

    def _call(self, what: Callable[[], None]) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(what)

    def _wake(self) -> None:
        for event in self._watchers:
            event.set()
