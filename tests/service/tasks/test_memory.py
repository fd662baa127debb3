"""A task that moves gives memory back when nothing of it is held any more; one that only reads gives none back."""

from __future__ import annotations

import threading
import weakref
from pathlib import Path
from typing import Any

import pytest

from service.tasks import store as tasks
from service.tasks.store import TaskStore


class Result(dict[str, Any]):
    """A result to which there may be weak references."""


class Recorder:
    def append(self, kind: str, data: dict[str, Any]) -> None:
        """Forget everything."""


def test_memory_is_given_back_after_the_motions_when_their_results_are_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results: list[weakref.ref[Result]] = []
    held: list[bool] = []
    given_back = threading.Event()

    def give_back() -> None:
        held.extend(result() is not None for result in results)
        given_back.set()

    def work(_: Any) -> Result:
        made = Result(image=[1, 2, 3])
        results.append(weakref.ref(made))
        return made

    monkeypatch.setattr(tasks, "return_free_memory", give_back)
    store = TaskStore(tmp_path, recorder=Recorder(), stop_motion=lambda: None)
    assert store.start("read", {}, work, moves=False).wait(10.0)
    assert store.start("read", {}, work, moves=False).wait(10.0)
    assert store.start("move", {}, work, moves=True).wait(10.0)
    assert given_back.wait(10.0)
    assert held == [False, False, False]
    store.close()
