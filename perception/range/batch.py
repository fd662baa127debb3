"""Thousands of recorded scans on dask.distributed: the same result whatever the number of workers.

A task holds at least 20 images, because handing one over costs about as much as a tenth of an image. A worker that is
lost is replaced and its tasks run again (`retries`); an image that cannot be read becomes a result with its error.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from hal.errors import CellError, ConfigError, InvalidRequest
from perception.range.analyse import analyse
from perception.range.recordings import load_recording
from perception.range.render import scene_json

IMAGES_A_TASK = 20
RETRIES = 3
SUFFIXES = (".npz", ".png")


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchResult:
    """What one recording gave: `scene` as `render.scene_json`, or `error` and no scene."""

    name: str
    scene: dict[str, Any] | None
    error: str | None


def recordings_in(folder: Path) -> list[Path]:
    """The recordings of a folder, in the order of their names.

    Raises:
        InvalidRequest: there is no such folder, or it holds no npz and no png.
    """
    if not folder.is_dir():
        raise InvalidRequest(f"{folder} is no folder", hint="give the folder that holds the recordings")
    paths = sorted(p for p in folder.iterdir() if p.suffix in SUFFIXES)
    if not paths:
        raise InvalidRequest(f"{folder} holds no recordings", hint=f"expected {' or '.join(SUFFIXES)} files")
    return paths


def analyse_files(paths: Sequence[str]) -> list[BatchResult]:
    """Analyse recordings one after the other: what one task does on a worker."""
    return [_one(Path(path)) for path in paths]


def _one(path: Path) -> BatchResult:
    try:
        depth, sensor = load_recording(path)
        scene = analyse(depth, sensor)
    except CellError as error:
        return BatchResult(name=path.name, scene=None, error=f"{type(error).__name__}: {error.what}")
    return BatchResult(name=path.name, scene=scene_json(scene), error=None)


def tasks_of(paths: Sequence[Path], images_a_task: int = IMAGES_A_TASK) -> list[list[str]]:
    """Paths in groups of `images_a_task`; the last group takes the rest, so none is smaller."""
    count = max(1, len(paths) // max(images_a_task, 1))
    names = [str(p) for p in paths]
    return [names[len(names) * k // count : len(names) * (k + 1) // count] for k in range(count)]


def batch_range(
    folder: Path,
    *,
    scheduler: str = "local",
    workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> list[BatchResult]:
    """Analyse every recording of a folder.

    Args:
        scheduler: "local" starts `workers` processes here; "tcp://host:port" uses a running dask scheduler, whose
            workers must see the folder under the same path.
        progress: called with images done and images in all after each task.

    Returns:
        one result a recording, in the order of names, the same for any number of workers.

    Raises:
        InvalidRequest: the folder holds no recordings.
        ConfigError: the scheduler is neither "local" nor a tcp address that answers.
    """
    groups = tasks_of(recordings_in(folder))
    total = sum(len(g) for g in groups)
    with _client(scheduler, workers) as client:
        futures = client.map(analyse_files, groups, retries=RETRIES, pure=False)
        if progress is not None:
            _watch(futures, groups, progress, total)
        gathered: list[list[BatchResult]] = client.gather(futures)
    return [result for group in gathered for result in group]


def write_results(path: Path, results: Sequence[BatchResult]) -> None:
    """One JSON object a line: name, scene or error."""
    lines = (json.dumps({"name": r.name, "scene": r.scene, "error": r.error}) for r in results)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _watch(futures: list[Any], groups: list[list[str]], progress: Callable[[int, int], None], total: int) -> None:
    distributed: Any = import_module("distributed")
    sizes = {future.key: len(group) for future, group in zip(futures, groups, strict=True)}
    done = 0
    for future in distributed.as_completed(futures):
        done += sizes[future.key]
        progress(done, total)


@contextmanager
def _client(scheduler: str, workers: int) -> Iterator[Any]:
    distributed: Any = import_module("distributed")
    if scheduler == "local":
        # One thread a worker: the compiled loops hold no lock, but Python between them does.
        with (
            distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
            ) as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
        return
    if not scheduler.startswith("tcp://"):
        raise ConfigError(f"scheduler is {scheduler!r}", hint='use "local" or "tcp://host:port"')
    try:
        client = distributed.Client(scheduler, timeout="10s")
    except OSError as error:
        raise ConfigError(f"no dask scheduler answers at {scheduler}", hint="start one: dask scheduler") from error
    with client:
        yield client
