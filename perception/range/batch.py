"""Analysis of thousands of recordings on dask.distributed; the result does not depend on the number of workers.

A task has at least 20 images, because its transfer costs about as much as a tenth of an image. A worker that dies is
replaced and its tasks run again; an image that cannot be read gives a result with the error. The results of a task are
saved as soon as it ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from hal.errors import CellError, InvalidRequest
from hal.workers import as_they_end, workers_of
from perception.range.analysis import analyse
from perception.range.batch_results import BatchResult, KeptResults
from perception.range.recordings import AS_FILED, SUFFIXES, Reading, load_recording
from perception.range.render import MARK, scene_json

IMAGES_A_TASK = 20  # least number of images per task
RETRIES = 3  # of a task whose worker died


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
        with workers_of(scheduler, workers) as client:
            task = partial(analyse_files, reading=reading)
            futures = client.map(task, tasks_of(missing), retries=RETRIES, pure=False)
            for group in as_they_end(client, futures):
                results |= {result.name: result for result in group}
                if kept:
                    kept.add(group)
                if progress:
                    progress(len(results), len(recordings))
    return [results[path.name] for path in recordings]
