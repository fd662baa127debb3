"""Files that a swapped device may read: an HTTP client names recordings of one folder, not any file of the machine."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from hal.config import DeviceSection
from hal.errors import ConfigError, InvalidRequest
from hal.registry import device_factory, options_model
from service.processes.device_slots import WIRE_KEYS

RECORDINGS = "recordings"
ALWAYS_FILES = {"capture", "replay"}  # in drivers that do not name their options, too


def with_recordings(section: DeviceSection, own: DeviceSection, *, runs_dir: Path) -> DeviceSection:
    """The section with the paths of its files, each of them below `runs_dir/recordings`.

    What stands so in the cell file (`own`) may stay as it is.

    Raises:
        InvalidRequest: an option names a file elsewhere, or a file to write.
    """
    files = _files(section.driver)
    options = {
        key: _inside(key, value, runs_dir)
        if key in files and isinstance(value, str) and value != own.options.get(key)
        else value
        for key, value in section.options.items()
    }
    return section.model_copy(update={"options": options})


def _files(driver: str) -> set[str]:
    """Names of the options that stand for files; wires are none."""
    try:
        model = options_model(device_factory(driver))
    except ConfigError:  # connecting says so
        return ALWAYS_FILES
    fields = {} if model is None else model.model_fields
    named = {name for name, field in fields.items() if Path in (field.annotation, *get_args(field.annotation))}
    return (named | ALWAYS_FILES) - set(WIRE_KEYS)


def _inside(key: str, value: str, runs_dir: Path) -> str:
    if key == "capture":
        raise InvalidRequest("captures cannot be started over HTTP", hint="put capture into the cell file")
    folder = (runs_dir / RECORDINGS).resolve()
    path = (folder / value).resolve()  # links are followed before it is judged
    if not path.is_relative_to(folder):
        raise InvalidRequest(
            f"options.{key}: over HTTP files are read from {folder} alone",
            hint=f"put the recording there and name it relative to that folder, or put {key} into the cell file",
            folder=str(folder),
        )
    return str(path)
