"""A driver's tier follows from its record alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.errors import ConfigError
from service.commissioning.driver_records import (
    Conformance,
    Docs,
    DriverRecord,
    FaultMatrix,
    HardwareReport,
    Replug,
    Setup,
    Stamps,
    ThirdParty,
    parse_record,
    tier_of,
    write_record,
)

KIT = Conformance(passed=12, skipped=0)
FAULTS = FaultMatrix(cells=22, seconds_per_cell=2.0, good=900, errors=100, wrong=0, stale=0, hung=0, untyped=0)
REPLUG = Replug(times=20, worst_s=0.4, leaked_descriptors=0, leaked_threads=0)
STAMPS = Stamps(samples=500, p99_s=0.0012)
PLUGGED = Setup(faults=FAULTS, replug=REPLUG, stamps=STAMPS)
THIRD = ThirdParty(package="their-client", version="1.0", test="test_it", passed=True)
REAL = HardwareReport(date="2026-11-23", cell="cell.toml", link="serial", level="read", conformance=KIT)


def record(**changed: Any) -> DriverRecord:
    """Return a record that meets every criterion, with changes."""
    whole: dict[str, Any] = {
        "driver": "serial:acme",
        "date": "2026-11-23",
        "panelwright": "0.1.0",
        "python": "3.11",
        "machine": "Linux",
        "conformance": KIT,
        "docs": Docs(has_section=True),
        "setups": {"serial": PLUGGED},
        "third_party": (THIRD,),
        "hardware": (REAL,),
    }
    return DriverRecord(**{**whole, **changed})


def test_a_driver_without_a_record_has_no_tier() -> None:
    assert tier_of(None) == "none"


@pytest.mark.parametrize(
    ("changed", "tier"),
    [
        ({}, "platinum"),
        ({"hardware": ()}, "gold"),
        (
            {
                "hardware": (
                    REAL,
                    REAL.model_copy(update={"conformance": Conformance(passed=3, skipped=0, failed=("x",))}),
                )
            },
            "gold",
        ),
        ({"third_party": ()}, "silver"),
        ({"third_party": (THIRD, THIRD.model_copy(update={"passed": False}))}, "silver"),
        ({"setups": {"a": PLUGGED, "b": PLUGGED.model_copy(update={"stamps": None})}}, "silver"),
        ({"setups": {"a": PLUGGED.model_copy(update={"stamps": Stamps(samples=9, p99_s=0.0021)})}}, "silver"),
        ({"setups": {"a": PLUGGED.model_copy(update={"faults": FAULTS.model_copy(update={"wrong": 1})})}}, "bronze"),
        ({"setups": {"a": PLUGGED.model_copy(update={"faults": FAULTS.model_copy(update={"untyped": 1})})}}, "bronze"),
        (
            {"setups": {"a": PLUGGED.model_copy(update={"replug": REPLUG.model_copy(update={"worst_s": 1.1})})}},
            "bronze",
        ),
        ({"setups": {}}, "bronze"),
        ({"docs": Docs(has_section=True, undescribed=("port",))}, "none"),
        ({"conformance": Conformance(passed=0, skipped=12)}, "none"),
        ({"conformance": None}, "none"),
    ],
)
def test_each_criterion_that_is_not_met_lowers_the_tier(changed: dict[str, Any], tier: str) -> None:
    assert tier_of(record(**changed)) == tier


def test_a_record_is_read_as_it_was_written_and_cannot_claim_a_tier(tmp_path: Path) -> None:
    path = write_record(tmp_path / "records", record())
    text = path.read_text()
    assert path.name == "serial-acme.json"
    assert parse_record(text, source="x") == record()
    with pytest.raises(ConfigError, match="tier"):
        parse_record(text.replace('"driver"', '"tier": "platinum", "driver"', 1), source="x")
