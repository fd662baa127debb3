"""Adds the results of the conformance tests to the records of the drivers, for `panelwright conform --record`."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from hal.config import Cell
from service.commissioning.conform_report import Notebook, PromiseResult
from service.commissioning.driver_options import describe
from service.commissioning.driver_records import (
    Conformance,
    Docs,
    DriverRecord,
    HardwareReport,
    file_name,
    installed_record,
    parse_record,
    write_record,
)

NO_DEVICE = ("none", "simulation")  # wires without a device at the other end


def update_records(folder: Path, cell: Cell, devices: Sequence[str], notebook: Notebook) -> list[Path]:
    """Write the records of the devices' drivers into a folder; returns their paths.

    The result counts as that of the emulator if the cell file emulates the device, and else as a hardware report.
    Simulated, played and replayed devices have no record.

    Raises:
        ConfigError: a record in the folder is damaged, or the folder cannot be written.
    """
    written = []
    for name in devices:
        section = cell.file.devices[name]
        if describe(section.driver).wire in NO_DEVICE or "replay" in section.options:
            continue
        findings = [finding for finding in notebook.findings if finding.device == name]
        if result := _conformance(findings):
            before = _before(folder, section.driver)
            written.append(write_record(folder, _with(before, cell, name, result, findings, notebook.level)))
    return written


def _conformance(findings: list[PromiseResult]) -> Conformance | None:
    """Return the counts of the promises; None if nothing was tried."""
    by_outcome = {
        word: [one.promise for one in findings if one.outcome == word] for word in ("passed", "skipped", "failed")
    }
    if not any(by_outcome.values()):
        return None
    return Conformance(
        passed=len(by_outcome["passed"]), skipped=len(by_outcome["skipped"]), failed=tuple(by_outcome["failed"])
    )


def _before(folder: Path, driver: str) -> DriverRecord:
    """Return the record in the folder, else the installed one, else a new one."""
    path = folder / file_name(driver)
    if path.is_file():
        return parse_record(path.read_text(encoding="utf-8"), source=str(path))
    undescribed = tuple(option.key for option in describe(driver).options if not option.description)
    return installed_record(driver) or DriverRecord(
        driver=driver,
        date=_today(),
        panelwright=version("panelwright"),
        python=platform.python_version(),
        machine=f"{platform.system()} {platform.machine()}",
        docs=Docs(has_section=False, undescribed=undescribed),
    )


def _with(
    before: DriverRecord, cell: Cell, name: str, result: Conformance, findings: list[PromiseResult], level: str
) -> DriverRecord:
    told = {"date": _today(), "panelwright": version("panelwright"), "python": platform.python_version()}
    if name in cell.file.emulators:
        return before.model_copy(update={**told, "conformance": result})
    report = HardwareReport(
        date=_today(),
        cell=cell.path.name,
        link=next((one.link for one in findings if one.link), ""),
        level=level,
        conformance=result,
    )
    return before.model_copy(update={**told, "hardware": (*before.hardware, report)})


def _today() -> str:
    return datetime.now(UTC).date().isoformat()
