"""Workers for long tasks: processes of this machine, or those of a dask scheduler on other machines.

A worker that dies is replaced, and its tasks run again. Dask is imported when the first workers are asked for.
"""

from __future__ import annotations

import logging
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import resource_tracker
from typing import Any

from hal.errors import ConfigError

LOOK_S = 10.0  # interval at which the scheduler is asked whether it still has workers
ALONE_LOOKS = 6  # successive intervals without any worker that end the work; a worker is replaced within seconds


def as_they_end(client: Any, futures: Sequence[Any]) -> Iterator[Any]:
    """Yield the result of each task as it ends.

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
                result = future.result()
            except (distributed.KilledWorker, distributed.CancelledError, OSError) as error:
                lost = ConfigError(f"a task was lost for good: {error}", hint="see the workers' logs; out of memory?")
            except ModuleNotFoundError as error:
                hint = "install panelwright where the workers run"
                raise ConfigError(f"a worker lacks {error.name!r}", hint=hint) from error
            else:
                yield result
    if lost is not None:
        raise lost


@contextmanager
def workers_of(scheduler: str, workers: int) -> Iterator[Any]:
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
            dashboard_address="127.0.0.1:0",  # None would take port 8787, and warn where it is taken
            host="127.0.0.1",
            silence_logs=logging.ERROR,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
