"""Analysis of thousands of recordings on dask.distributed; the result does not depend on the number of workers.

A task has at least 20 images, because its transfer costs about as much as a tenth of an image. A worker that dies is
replaced and its tasks run again; an image that cannot be read gives a result with the error. The results of a task are
saved as soon as it ends.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

from hal.errors import CellError, ConfigError, InvalidRequest
from perception.range.analysis import analyse
from perception.range.batch_results import BatchResult, KeptResults
from perception.range.recordings import AS_FILED, SUFFIXES, Reading, load_recording
from perception.range.render import MARK, scene_json

IMAGES_A_TASK = 20  # least number of images per task
RETRIES = 3  # of a task whose worker died
LOOK_S = 10.0  # interval at which the scheduler is asked whether it still has workers
ALONE_LOOKS = 6  # successive intervals without any worker that end the batch; a worker is replaced within seconds


def recordings_in(folder: Path) -> list[Path]:
    """Return the recordings of a folder in the order of their names, without the pictures that were drawn of them.

    Raises:
        InvalidRequest: there is no such folder, or it holds no recording.
    """
    if not folder.is_dir():
        raise InvalidRequest(f"{folder} is no folder", hint="give the folder that holds the recordings")
    paths = sorted(p for p in folder.resolve().iterdir() if p.suffix.lower() in SUFFIXES and MARK not in p.suffixes)
    if not paths:
        raise InvalidRequest(f"{folder} holds no recordings", hint=f"expected {', '.join(SUFFIXES)} files")
    return paths


def analyse_files(paths: Sequence[str], reading: Reading = AS_FILED) -> list[BatchResult]:
    """Analyse recordings one after the other, as one task on a worker."""
    return [_one(Path(path), reading) for path in paths]


def _one(path: Path, reading: Reading) -> BatchResult:
    """Analyse one recording; an error becomes part of the result."""
    try:
        depth, sensor = load_recording(path, reading=reading)
        scene = analyse(depth, sensor)
    except CellError as error:
        return BatchResult(name=path.name, scene=None, error=f"{type(error).__name__}: {error.what}")
    except Exception as defect:
        # A defect of the program on one image must not cost the results of the others.
        return BatchResult(name=path.name, scene=None, error=f"Defect: {type(defect).__name__}: {defect}")
    return BatchResult(name=path.name, scene=scene_json(scene), error=None)


def tasks_of(paths: Sequence[Path], images_a_task: int = IMAGES_A_TASK) -> list[list[str]]:
    """Divide paths into groups of at least `images_a_task`; all groups are of about the same size."""
    count = max(1, len(paths) // max(images_a_task, 1))
    names = [str(p) for p in paths]
    return [names[len(names) * k // count : len(names) * (k + 1) // count] for k in range(count)]


def batch_range(
    folder: Path,
    *,
    scheduler: str = "local",
    workers: int = 2,
    reading: Reading = AS_FILED,
    progress: Callable[[int, int], None] | None = None,
    kept: KeptResults | None = None,
) -> list[BatchResult]:
    """Analyse every recording of a folder.

    Args:
        scheduler: "local" starts `workers` processes here; "tcp://host:port" uses a running dask scheduler, whose
            workers must see the folder under the same path.
        reading: what the files do not say, as for `load_recording`.
        progress: called with the numbers of images done and of all images: after each task, and at the start if an
            earlier run has left results.
        kept: supplies the valid results of an earlier run, and saves those of each task as it ends.

    Returns:
        one result per recording, in the order of names, the same for any number of workers.

    Raises:
        InvalidRequest: the folder holds no recordings.
        ConfigError: the scheduler is neither "local" nor a tcp address that answers, or no worker is left.
    """
    recordings = recordings_in(folder)
    results = {} if kept is None else kept.of(recordings)
    if progress and results:
        progress(len(results), len(recordings))
    missing = [path for path in recordings if path.name not in results]
    if missing:
        with _client(scheduler, workers) as client:
            task = partial(analyse_files, reading=reading)
            futures = client.map(task, tasks_of(missing), retries=RETRIES, pure=False)
            for group in _as_they_end(client, futures):
                results |= {result.name: result for result in group}
                if kept:
                    kept.add(group)
                if progress:
                    progress(len(results), len(recordings))
    return [results[path.name] for path in recordings]


def _as_they_end(client: Any, futures: Sequence[Any]) -> Iterator[list[BatchResult]]:
    """Yield the results of each task as it ends.

    Raises:
        ConfigError: no worker is left, or a worker lacks a module (raised at once); a task was lost although it was
            repeated (raised after the other tasks have ended).
    """
    distributed: Any = import_module("distributed")
    waiting, alone, lost = set(futures), 0, None
    while waiting:
        try:
            ended = distributed.wait(waiting, timeout=LOOK_S, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            ended = set()
        alone = 0 if ended or client.nthreads() else alone + 1
        if alone == ALONE_LOOKS:
            raise ConfigError("all workers are gone and none came back", hint="start workers: dask worker tcp://...")
        waiting -= ended
        for future in ended:
            try:
                group: list[BatchResult] = future.result()
            except (distributed.KilledWorker, distributed.CancelledError, OSError) as error:
                lost = ConfigError(f"a task was lost for good: {error}", hint="see the workers' logs; out of memory?")
            except ModuleNotFoundError as error:
                hint = "install panelwright where the workers run"
                raise ConfigError(f"a worker lacks {error.name!r}", hint=hint) from error
            else:
                yield group
    if lost is not None:
        raise lost


@contextmanager
def _client(scheduler: str, workers: int) -> Iterator[Any]:
    """Yield a client of a local cluster, or of the scheduler at an address, with at least one worker."""
    distributed: Any = import_module("distributed")
    if scheduler == "local":
        with _local_cluster(distributed, workers) as cluster, distributed.Client(cluster) as client:
            yield client
        return
    if not scheduler.startswith("tcp://"):
        raise ConfigError(f"scheduler is {scheduler!r}", hint='use "local" or "tcp://host:port"')
    try:
        client = distributed.Client(scheduler, timeout="10s")
    except (OSError, ValueError) as error:
        raise ConfigError(f"no dask scheduler answers at {scheduler}", hint="start one: dask scheduler") from error
    with client:
        try:
            client.wait_for_workers(1, timeout=LOOK_S)
        except TimeoutError as error:
            raise ConfigError(f"{scheduler} has no workers", hint=f"start some: dask worker {scheduler}") from error
        yield client


def _local_cluster(distributed: Any, workers: int) -> Any:
    """Start worker processes on this machine that ignore Ctrl-C.

    A terminal sends SIGINT to all processes of a command, and each worker would print a traceback; workers end with the
    cluster instead. Threads and processes inherit the signal mask, so a worker that is replaced later ignores SIGINT,
    too.
    """
    resource_tracker.ensure_running()  # if it started later, it would unblock the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        # One thread per worker: compiled loops release Python's global lock, but the code between them holds it.
        return distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            host="127.0.0.1",
            silence_logs=logging.ERROR,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
