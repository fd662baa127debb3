"""Records of what was measured of each driver, and the tier that follows from a record.

A record is a JSON file, `records/DRIVER.json` beside the driver's package, which an entry point in the group
`panelwright.records` names. No record contains a tier.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from importlib.metadata import entry_points
from importlib.resources import files
from pathlib import Path

from pydantic import ValidationError

from hal.errors import ConfigError
from hal.strict import Strict

RECORDS = "panelwright.records"
BACK_S = 1.0  # a driver must give data again this long after its device is plugged in again
STAMP_S = 0.002  # a time stamp may be wrong by this, at the 99th percentile


class Conformance(Strict):
    """Result of the conformance kit: numbers of promises that passed or were skipped, and the names of failed ones."""

    passed: int
    skipped: int
    failed: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether promises were tested and none failed."""
        return self.passed > 0 and not self.failed


class FaultMatrix(Strict):
    """Counts over all cells (ten faults and their mixture, each in every 3rd and 20th frame).

    Attributes:
        good: samples that were right and in time.
        errors: typed errors, which name the device.
        blind: cells without a good sample.
    """

    cells: int
    seconds_per_cell: float
    good: int
    errors: int
    wrong: int
    stale: int
    hung: int
    untyped: int
    blind: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether there was no wrong, unmarked stale, hung or untyped answer."""
        return self.good > 0 and not (self.wrong or self.stale or self.hung or self.untyped)


class Replug(Strict):
    """Time from the return of the port to the first new sample, and what leaked meanwhile."""

    times: int
    worst_s: float
    leaked_descriptors: int
    leaked_threads: int

    @property
    def is_good(self) -> bool:
        """Whether the driver was back in time and leaked nothing."""
        return self.worst_s <= BACK_S and self.leaked_descriptors <= 0 and self.leaked_threads <= 0


class Stamps(Strict):
    """Distance of the time stamps to the true times, at the 99th percentile."""

    samples: int
    p99_s: float

    @property
    def is_good(self) -> bool:
        """Whether the stamps are accurate enough."""
        return self.samples > 0 and self.p99_s <= STAMP_S


class Setup(Strict):
    """What was measured of a driver in one setup (mode, transport); None for what was not measured."""

    faults: FaultMatrix | None = None
    replug: Replug | None = None
    stamps: Stamps | None = None


class ThirdParty(Strict):
    """A test in which software of a third party was the far side, or a client of the driver's emulator."""

    package: str
    version: str
    test: str
    passed: bool


class Docs(Strict):
    """Whether the driver has a section in the reference, and its options without a description."""

    has_section: bool
    undescribed: tuple[str, ...] = ()


class HardwareReport(Strict):
    """Result of `panelwright conform` on a device that no emulator stands in for."""

    date: str
    cell: str
    link: str
    level: str
    conformance: Conformance


class DriverRecord(Strict):
    """Everything that was measured of one driver."""

    schema_version: int = 1
    driver: str
    date: str
    panelwright: str
    python: str
    machine: str
    conformance: Conformance | None = None
    docs: Docs | None = None
    setups: dict[str, Setup] = {}
    third_party: tuple[ThirdParty, ...] = ()
    hardware: tuple[HardwareReport, ...] = ()


class Check(StrEnum):
    """The criteria of the tiers."""

    CONFORMANCE = "conformance"
    DOCS = "docs"
    FAULTS = "fault matrix"
    REPLUG = "re-plug"
    STAMPS = "time stamps"
    THIRD_PARTY = "third party"
    HARDWARE = "hardware"


TIERS: Mapping[str, tuple[Check, ...]] = {  # each tier needs its checks and those of the tiers before it
    "bronze": (Check.CONFORMANCE, Check.DOCS),
    "silver": (Check.FAULTS, Check.REPLUG),
    "gold": (Check.STAMPS, Check.THIRD_PARTY),
    "platinum": (Check.HARDWARE,),
}


def checks_of(record: DriverRecord) -> dict[Check, bool | None]:
    """Return for each criterion whether the driver meets it in every setup; None if it was not measured."""
    setups = record.setups.values()
    third = [one.passed for one in record.third_party]
    hardware = [report.conformance.is_good for report in record.hardware]
    docs = record.docs
    return {
        Check.CONFORMANCE: None if record.conformance is None else record.conformance.is_good,
        Check.DOCS: None if docs is None else docs.has_section and not docs.undescribed,
        Check.FAULTS: _all([None if s.faults is None else s.faults.is_good for s in setups]),
        Check.REPLUG: _all([None if s.replug is None else s.replug.is_good for s in setups]),
        Check.STAMPS: _all([None if s.stamps is None else s.stamps.is_good for s in setups]),
        Check.THIRD_PARTY: all(third) if third else None,
        Check.HARDWARE: hardware[-1] if hardware else None,  # the newest report counts
    }


def _all(results: list[bool | None]) -> bool | None:
    """Return False if one setup fails, None if one was not measured, else True."""
    if False in results:
        return False
    return None if not results or None in results else True


def tier_of(record: DriverRecord | None) -> str:
    """Return the highest tier whose criteria, and those of all tiers before, are met; `none` without one."""
    if record is None:
        return "none"
    checks, reached = checks_of(record), "none"
    for tier, needed in TIERS.items():
        if not all(checks[check] for check in needed):
            break
        reached = tier
    return reached


def file_name(driver: str) -> str:
    """Return the name of the file of a driver's record."""
    return f"{driver.replace(':', '-')}.json"


def installed_record(driver: str) -> DriverRecord | None:
    """Return the record of an installed driver; None without one.

    Raises:
        ConfigError: the file is not a record.
    """
    for point in entry_points(group=RECORDS):
        file = files(point.value).joinpath("records", file_name(driver))
        if file.is_file():
            return parse_record(file.read_text(encoding="utf-8"), source=str(file))
    return None


def parse_record(text: str, *, source: str) -> DriverRecord:
    """Return the record in a JSON text.

    Raises:
        ConfigError: it is not a record.
    """
    try:
        return DriverRecord.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        what = f"{source} is not a record: {'.'.join(map(str, first['loc']))}: {first['msg']}"
        raise ConfigError(what, hint="records are written by `panelwright conform --record FOLDER`") from None


def write_record(folder: Path, record: DriverRecord) -> Path:
    """Write a record into a folder, made if missing; returns its path.

    Raises:
        ConfigError: the file cannot be written.
    """
    path = folder / file_name(record.driver)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path.write_text(record.model_dump_json(indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}", hint="choose another folder") from error
    return path
