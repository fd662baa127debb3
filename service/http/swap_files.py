"""Restricts the files that a client may name for a device to one folder of recordings."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

from hal.config import DeviceSection
from hal.errors import ConfigError, InvalidRequest
from hal.registry import device_factory, options_model
from service.core import RECORDINGS
from service.processes.device_slots import WIRE_KEYS

ALWAYS_FILES = {"capture", "replay"}  # also in drivers that do not declare their options


def with_recordings(section: DeviceSection, own: DeviceSection, *, runs_dir: Path) -> DeviceSection:
    """Return the section with absolute paths of its files, all of which must be below `runs_dir/recordings`.

    An option that has the same value in the cell file (`own`) is allowed.

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
    """Return the names of the options that are files; ports and addresses are not."""
    try:
        model = options_model(device_factory(driver))
    except ConfigError:  # reported when the device is connected
        return ALWAYS_FILES
    fields = {} if model is None else model.model_fields
    named = {name for name, field in fields.items() if Path in (field.annotation, *get_args(field.annotation))}
    return (named | ALWAYS_FILES) - set(WIRE_KEYS)


def _inside(key: str, value: str, runs_dir: Path) -> str:
    if key == "capture":
        raise InvalidRequest("captures cannot be started over HTTP", hint="put capture into the cell file")
    folder = (runs_dir / RECORDINGS).resolve()
    path = (folder / value).resolve()  # the check applies to the target of symbolic links
    if not path.is_relative_to(folder):
        raise InvalidRequest(
            f"options.{key}: over HTTP, files are read only from {folder}",
            hint=f"put the recording there and name it relative to that folder, or put {key} into the cell file",
            folder=str(folder),
        )
    return str(path)
