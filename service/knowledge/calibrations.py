"""Calibration records measured on this machine, which replace those of the cell file; one folder per cell.

The cell file's own records are the nominal values (a simulated cell draws its true values around them). The measured
records, in `RUNS/calibrations/<cell>/`, are those that tasks use; older versions are kept.
"""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from pathlib import Path

from hal.atomic_write import flush_folder, write_atomically
from hal.calibration import CalibrationRecord, load_calibration
from hal.config import Cell
from hal.errors import ConfigError
from service.errors import NoSuchTask

FOLDER = "calibrations"
OLDER = "older"


class NoSuchCalibration(NoSuchTask):
    """No device of the cell has a calibration under that name, or nothing was calibrated here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibrated:
    """The record of a device that is in use. `is_measured`: measured here; otherwise it is from the cell file."""

    device: str
    parent: str
    record: CalibrationRecord
    is_measured: bool
    path: Path
    older: tuple[Path, ...]


class Calibrations:
    """The calibration records of one cell."""

    _lock = threading.Lock()  # shared by all instances of this process

    def __init__(self, folder: Path, cell: Cell) -> None:
        self.folder = folder
        self._cell = cell

    @classmethod
    def of_runs(cls, runs_dir: Path, cell: Cell) -> Calibrations:
        """Return the records of a service's cell; each seed of a simulated cell has its own, because the sensors differ."""
        section = cell.file.cell
        name = section.name if section.mode == "real" else f"{section.name}-seed{section.seed}"
        return cls(runs_dir / FOLDER / name, cell)

    def applied(self) -> Cell:
        """Return the cell with the measured records in place of the cell file's.

        Raises:
            ConfigError: a measured record is malformed; the error names it.
        """
        measured = {name: load_calibration(path) for name, path in self._measured().items()}
        if not measured:
            return self._cell
        return Cell.model_construct(
            path=self._cell.path,
            file=self._cell.file,
            panel=self._cell.panel,
            calibrations={**self._cell.calibrations, **measured},
        )

    def all(self) -> list[Calibrated]:
        """Return one entry per mounted device, in the order of the cell file."""
        cell, measured = self.applied(), self._measured()
        found = []
        for device, section in cell.file.devices.items():
            if section.mount is None:
                continue
            name = section.mount.calibration
            path = measured.get(name) or self._cell.calibration_path(name)
            older = tuple(sorted((self.folder / OLDER).glob(f"{name}.v*.toml"), key=lambda p: p.stat().st_mtime_ns))
            found.append(
                Calibrated(
                    device=device,
                    parent=section.mount.parent,
                    record=cell.calibrations[name],
                    is_measured=name in measured,
                    path=path,
                    older=older,
                )
            )
        return found

    def of(self, device: str) -> Calibrated:
        """Return the record of one device.

        Raises:
            NoSuchCalibration: there is no such device, or it has no mount.
        """
        for entry in self.all():
            if entry.device == device:
                return entry
        raise NoSuchCalibration(
            f"no calibration of a device called {device[:60]!r}",
            hint=f"calibrated devices: {', '.join(entry.device for entry in self.all())}",
        )

    def write(self, record: CalibrationRecord) -> Path:
        """Store a record as the one in use, atomically; the previous one moves to `older/`.

        Raises:
            ConfigError: the device has no mount, so nothing would read the record.
        """
        from perception.calibration import to_toml

        section = self._cell.file.devices[record.device]
        if section.mount is None:
            raise ConfigError(
                f"devices.{record.device} has no mount, so its calibration belongs nowhere",
                hint="add mount = { parent = ..., calibration = ... } to the cell file",
                file=str(self._cell.path),
            )
        path = self.folder / f"{section.mount.calibration}.toml"
        with self._lock:
            (self.folder / OLDER).mkdir(parents=True, exist_ok=True)
            before = path.read_text(encoding="utf-8") if path.exists() else None
            if before is not None:
                version = load_calibration(path).version
                os.link(path, _unused(self.folder / OLDER / f"{path.stem}.v{version}.toml"))
                flush_folder(self.folder / OLDER)
            write_atomically(path, to_toml(record, over=before))
        return path

    def forget(self, device: str) -> None:
        """Return to the cell file's own record; the measured one moves to `older/`.

        Raises:
            NoSuchCalibration: nothing was measured for the device.
        """
        entry = self.of(device)
        if not entry.is_measured:
            raise NoSuchCalibration(
                f"{device} uses the record of the cell file: there is nothing to forget",
                hint="POST /v1/calibrations measures one",
            )
        with self._lock:
            older = self.folder / OLDER / f"{entry.path.stem}.v{entry.record.version}.toml"
            entry.path.rename(_unused(older))
            flush_folder(self.folder / OLDER)
            flush_folder(self.folder)

    def _measured(self) -> dict[str, Path]:
        """Return the files of this folder that replace a record of the cell, by the record's name."""
        return {name: path for name in self._cell.calibrations if (path := self.folder / f"{name}.toml").exists()}


def _unused(path: Path) -> Path:
    """Return the path, or a numbered one if it exists, because an older record is never overwritten."""
    count, free = 1, path
    while free.exists():
        count += 1
        free = path.with_name(f"{path.stem}-{count}.toml")
    return free
