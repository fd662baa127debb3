"""Reads a recording for its replay: the cell, its tasks, and the calls of each task. A recording that was cut off is
read up to the cut."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Footer, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from hal.config import Cell, load_cell
from hal.errors import ConfigError
from service.recording.codec import Unreadable, decode
from service.recording.foxglove import depth_of, pixels_of
from service.recording.session import CELL
from service.recording.writer import EVENTS, FORMAT, PROFILE

CALLS = "/calls/"
IMAGES = ("/image", "/range")
HINT = "give a file that `panelwright record` has written"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RecordedCall:
    """One call as it stands in the file: plain JSON values, which `Recording.value` makes values of."""

    number: int
    object: str
    method: str
    arguments: list[Any]
    keywords: dict[str, Any]
    value: Any
    error: dict[str, Any] | None
    time_s: float

    def __str__(self) -> str:
        return f"{self.object}.{self.method}"


@dataclass(slots=True, kw_only=True, eq=False)
class RecordedTask:
    """A task: what was asked, the calls that it made, in order, and how it ended (None: the recording ends before)."""

    id: str
    verb: str
    request: dict[str, Any]
    calls: list[RecordedCall] = field(default_factory=list)
    state: str | None = None
    result: Any = None
    problem: Any = None


@dataclass(slots=True, kw_only=True, eq=False)
class Recording:
    """A recording in memory.

    Attributes:
        about: facts such as cell, mode, seed and the versions of the programs that wrote it.
        files: the cell file, and every file that it refers to, by name.
        objects: methods, constants, capabilities and health of each object of the cell, as JSON values.
        tasks: in the order in which they were asked for.
        others: calls of pages and checks.
        is_cut: whether the file ends in the middle, because its writer was killed.
        end_s: cell time of the last call.
    """

    path: Path
    about: dict[str, str] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    objects: dict[str, Any] = field(default_factory=dict)
    tasks: list[RecordedTask] = field(default_factory=list)
    others: list[RecordedCall] = field(default_factory=list)
    is_cut: bool = False
    end_s: float = 0.0
    _images: dict[tuple[str, int], bytes] = field(default_factory=dict)
    _callers: dict[str, list[RecordedCall]] = field(default_factory=dict)

    @property
    def was_inline(self) -> bool:
        """Whether tasks and devices shared a process, so that no value was pickled between them."""
        return self.about.get("inline") == "true"

    def value(self, written: Any) -> Any:
        """Return the value that was written.

        Raises:
            Unreadable: it cannot be made again.
        """
        return decode(written, self._image)

    def unpack(self, folder: Path) -> Cell:
        """Write the recorded cell with all its files into a folder, and load it.

        Raises:
            ConfigError: the recording holds no cell, or this version refuses it.
        """
        for name, data in self.files.items():
            path = (folder / name).resolve()
            if not path.is_relative_to(folder.resolve()):
                raise ConfigError(f"{self.path} holds a file outside its folder: {name!r}", hint=HINT)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return load_cell(folder / CELL)

    def _image(self, reference: dict[str, Any]) -> NDArray[Any]:
        topic, sequence = reference["topic"], reference["sequence"]
        data = self._images.get((topic, sequence))
        if data is None:
            raise Unreadable(f"{self.path} lacks image {sequence} of {topic}", hint="the recording may be damaged")
        if topic.endswith("/range"):
            return depth_of(RawImage.FromString(data))
        return np.ascontiguousarray(pixels_of(CompressedImage.FromString(data)))


def open_recording(path: Path) -> Recording:
    """Read a recording.

    Raises:
        ConfigError: the file does not exist, or is not a recording of a cell.
    """
    recording = Recording(path=path)
    try:
        with path.open("rb") as stream:
            for topic, message in _records(stream, recording):
                _take(recording, topic, message)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror or error}", hint=HINT) from error
    _hand_out(recording)
    if CELL not in recording.files or not recording.objects:
        cut = " (it was cut off before the cell had started)" if recording.is_cut and recording.about else ""
        raise ConfigError(f"{path} is not a recording of a cell{cut}", hint=HINT)
    return recording


def numbers_of(path: Path) -> tuple[float, int]:
    """Return the duration in seconds and the number of messages, from the index; zeros for a file without one."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    if summary is None or summary.statistics is None:
        return 0.0, 0
    numbers = summary.statistics
    return 1e-9 * (numbers.message_end_time - numbers.message_start_time), numbers.message_count


def _records(stream: BinaryIO, recording: Recording) -> Iterator[tuple[str, Message]]:
    """Yield the messages that a replay needs, by topic; note the rest in the recording."""
    topics: dict[int, str] = {}
    recording.is_cut = True
    try:
        for record in StreamReader(stream).records:
            match record:
                case Message(channel_id=channel) if channel in topics:
                    yield topics[channel], record
                case Channel(id=channel, topic=topic) if topic == EVENTS or topic.startswith(CALLS):
                    topics[channel] = topic
                case Channel(id=channel, topic=topic) if topic.endswith(IMAGES):
                    topics[channel] = topic
                case Attachment(name=name, data=data):
                    recording.files[name] = data
                case Metadata(name=name, metadata=about) if name == PROFILE:
                    recording.about = _checked(about, recording.path)
                case Footer():
                    recording.is_cut = False
    except (EndOfFile, McapError, struct.error, zstandard.ZstdError, UnicodeDecodeError):
        return  # the writer was killed in the middle of a record, or this is no MCAP file at all


def _checked(about: dict[str, str], path: Path) -> dict[str, str]:
    if int(about.get("format", "0")) > FORMAT:
        newer = about.get("panelwright", "a newer version")
        raise ConfigError(f"{path} was written by panelwright {newer}", hint="replay it with that version")
    return about


def _take(recording: Recording, topic: str, message: Message) -> None:
    if topic.endswith(IMAGES):
        recording._images[topic, message.sequence] = message.data
        return
    try:
        written = json.loads(message.data)
        if topic == EVENTS:
            _event(recording, written["kind"], written["data"])
        else:
            _call(recording, written)
    except (KeyError, TypeError, ValueError) as error:
        raise ConfigError(f"{recording.path}: {topic} holds a message that is none: {error!r}", hint=HINT) from error


def _event(recording: Recording, kind: str, data: dict[str, Any]) -> None:
    if kind == "cell-objects" and not recording.objects:
        recording.objects = data["objects"]
    elif kind == "task-queued":
        recording.tasks.append(RecordedTask(id=data["task"], verb=data["verb"], request=data["request"]))
    elif kind == "task-ended":
        for task in recording.tasks:
            if task.id == data["task"]:
                task.state, task.result, task.problem = data["state"], data["result"], data["problem"]


def _call(recording: Recording, written: dict[str, Any]) -> None:
    caller = written.pop("caller")
    call = RecordedCall(**written)
    recording.end_s = max(recording.end_s, call.time_s)
    recording._callers.setdefault(caller, []).append(call)


def _hand_out(recording: Recording) -> None:
    """Give each task its calls. A task's first calls may stand before it, because two processes send them."""
    for task in recording.tasks:
        task.calls = recording._callers.pop(f"{task.verb} {task.id}", [])
    recording.others = [call for calls in recording._callers.values() for call in calls]
