"""Starts a recording of a service: the recorder's process, and what the recording says about the cell."""

from __future__ import annotations

import multiprocessing
import time
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol

import tomlkit

from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import ConfigError
from hal.frames import frame_tree
from hal.geometry import identity
from hal.host_process import HostProcess
from service.jsonable import jsonable
from service.knowledge.calibrations import Calibrations
from service.recording.endpoint import Endpoint
from service.recording.sender import FAILED, Note, Sender
from service.recording.writer import Contents, make_recorder

CELL, PANEL, CALIBRATIONS, KNOWLEDGE = "cell.toml", "panel.toml", "calibrations", "knowledge"
READY_S = 120.0  # a second on a free machine; a recording is not given up because the machine is busy
TASK_PROGRESS = "task-progress"


class Durable(Protocol):
    """A task recorder, such as the journal."""

    def append(self, kind: str, data: dict[str, Any]) -> None:
        """Record durably before returning."""
        ...


class Stepping(Protocol):
    """The part of a task that its progress needs."""

    id: str
    verb: str

    @property
    def step(self) -> str:
        """Description of the present step."""
        ...


@dataclass(slots=True, kw_only=True, eq=False)
class RecordingSession:
    """A recording that runs; closing it ends the file.

    Attributes:
        problem: why the recording has ended early; empty while it goes on.
    """

    path: Path
    endpoint: Endpoint
    _process: HostProcess
    _sender: Sender
    problem: str = ""
    _steps: dict[str, str] = field(default_factory=dict)

    @classmethod
    def start(cls, path: Path, cell: Cell, *, calibrations: Calibrations, inline: bool) -> RecordingSession:
        """Start the recorder's process.

        Args:
            cell: as its file says; the calibration records in use are written in place of its own.
            inline: whether tasks and devices share a process.

        Raises:
            ConfigError: the file exists or cannot be written.
            DeviceUnavailable: the process did not start.
        """
        if path.exists():
            raise ConfigError(f"{path} exists already", hint="choose another name, or remove it; nothing was written")
        if not path.absolute().parent.is_dir():
            raise ConfigError(f"{path} cannot be written: its folder does not exist", hint="make the folder first")
        try:
            path.touch()
            path.unlink()
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be written: {error.strerror}", hint="name a file in a folder of yours"
            ) from error
        contents = _contents(cell, calibrations, inline)
        process = HostProcess(make_recorder, path.absolute(), contents, name="recorder", ready_s=READY_S)
        endpoint = Endpoint(process.address, bytes(multiprocessing.current_process().authkey).hex())
        return cls(
            path=path, endpoint=endpoint, _process=process, _sender=endpoint.sender(report=lambda _kind, _data: None)
        )

    def recorder(self, inner: Durable) -> Durable:
        """Return a task recorder that writes to `inner`, and the same into the recording."""
        return RecordedTasks(inner, self)

    def note(self, kind: str, data: dict[str, Any]) -> None:
        """Record an event, without waiting."""
        if kind == FAILED:
            self.problem = str(data["why"])
        self._sender.put(Note(kind=kind, data=jsonable(data), wall_s=time.monotonic()))

    def on_task(self, task: Stepping) -> None:
        """Record the newest step of a task, if it is new."""
        step = task.step
        if step and self._steps.get(task.id) != step:
            self._steps[task.id] = step
            self.note(TASK_PROGRESS, {"task": task.id, "verb": task.verb, "step": step})

    def close(self) -> None:
        """Write what waits and end the file; a second call does nothing."""
        self._sender.close()
        self._process.close()


@dataclass(frozen=True, slots=True)
class RecordedTasks:
    """A task recorder that also writes the tasks into the recording."""

    inner: Durable
    session: RecordingSession

    def append(self, kind: str, data: dict[str, Any]) -> None:
        """Record durably in the inner recorder, then in the recording, which waits for nothing."""
        self.inner.append(kind, data)
        self.session.note(kind, data)


def _contents(cell: Cell, calibrations: Calibrations, inline: bool) -> Contents:
    applied = calibrations.applied()
    links = frame_tree(applied, identity()).links
    return Contents(
        about={
            "cell": cell.name,
            "mode": cell.file.cell.mode,
            "seed": str(cell.file.cell.seed),
            "inline": str(inline).lower(),
            "panelwright": version("panelwright"),
            "numpy": version("numpy"),
            "scipy": version("scipy"),
        },
        files=_files(cell, calibrations),
        mounts={
            name: (parent, pose.parent_from_child)
            for name, (parent, pose) in links.items()
            if name in cell.file.devices
        },
        lenses={
            name: record.intrinsics.intrinsics()
            for name in cell.names_of(DeviceKind.CAMERA)
            if cell.file.devices[name].mount is not None
            and (record := applied.calibration_of(name)).intrinsics is not None
        },
    )


def _files(cell: Cell, calibrations: Calibrations) -> dict[str, bytes]:
    """Return the cell file and all that it refers to, so that the cell can be loaded from the recording alone."""
    document = tomlkit.parse(cell.path.read_text(encoding="utf-8"))
    section: Any = document["cell"]
    section["panel"], section["calibrations"], section["seed"] = PANEL, CALIBRATIONS, cell.file.cell.seed
    document.get("simulation", {}).pop("built_panel", None)  # nothing is simulated when a recording is played
    files = {PANEL: cell.panel_path.read_bytes()}
    in_use = {cell.file.devices[entry.device].mount: entry.path for entry in calibrations.all()}
    files |= {
        f"{CALIBRATIONS}/{mount.calibration}.toml": path.read_bytes()
        for mount, path in in_use.items()
        if mount is not None
    }
    if (knowledge := cell.knowledge_path) is not None:
        section["knowledge"] = KNOWLEDGE
        files |= {
            f"{KNOWLEDGE}/{path.relative_to(knowledge).as_posix()}": path.read_bytes()
            for path in sorted(knowledge.rglob("*"))
            if path.is_file()
        }
    return {CELL: tomlkit.dumps(document).encode(), **files}
