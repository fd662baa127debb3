"""The measurements behind the records of drivers run, and their results come into the right record."""

from __future__ import annotations

from contextlib import closing

from benchmarks.drivers import record
from benchmarks.drivers.benches import BENCHES, bench
from benchmarks.drivers.faults import MIXED, RATES, Cell, StallProbe, fault_cell
from benchmarks.drivers.life import unplugging
from hal.registry import installed_drivers

FOUND = [
    {
        "test": "tests/drivers/test_a.py::TestA::test_x",
        "outcome": "passed",
        "package": None,
        "drivers": ["serial:tfmini"],
    },
    {
        "test": "tests/drivers/test_a.py::TestA::test_y",
        "outcome": "failed",
        "package": None,
        "drivers": ["serial:tfmini"],
    },
    {"test": "tests/drivers/test_b.py::test_z", "outcome": "passed", "package": "numpy", "drivers": ["serial:tfmini"]},
    {
        "test": "tests/drivers/test_b.py::test_s",
        "outcome": "skipped",
        "package": "absent",
        "drivers": ["serial:tfmini"],
    },
    {"test": "tests/drivers/test_c.py::test_o", "outcome": "passed", "package": None, "drivers": ["serial:bota"]},
]


def test_each_result_belongs_to_its_driver_and_a_skipped_test_proves_nothing() -> None:
    results = record._results("serial:tfmini", FOUND)
    assert (results["conformance"].passed, results["conformance"].failed) == (1, ("test_a.py::TestA::test_y",))
    assert [(one.package, one.passed) for one in results["third_party"]] == [("numpy", True)]
    assert record._results("udp:netft", FOUND) == {"conformance": None, "third_party": ()}


def test_a_driver_is_tested_by_the_files_that_name_it() -> None:
    assert "test_bota.py" in [path.name for path in record.test_files(["serial:bota"])]


def test_a_longer_name_is_not_the_section_of_a_shorter_one() -> None:
    docs = record._begun("serial:dynamixel").docs
    assert docs is not None and docs.has_section and not docs.undescribed


def test_the_setups_are_of_installed_drivers_and_have_their_own_names() -> None:
    assert {item.driver for item in BENCHES} <= set(installed_drivers())
    assert len({item.name for item in BENCHES}) == len(BENCHES)


def test_a_cell_of_the_matrix_counts_and_sums() -> None:
    item = bench("tfmini")
    with closing(StallProbe()) as probe:
        cell = fault_cell(item, "crc", 3, 0.3, probe)
    assert cell.good > 0 and cell.wrong == cell.untyped == 0
    cells = {(item.name, fault, every): cell for every in RATES for fault in (*map(str, item.faults), MIXED)}
    cells[item.name, MIXED, 3] = Cell(errors=1, wrong=2)
    found = record.faults_of(item, cells, 0.3)
    assert (found.cells, found.wrong, found.blind, found.is_good) == (22, 2, ("mixed, every 3",), False)


def test_unplugging_ends_with_data() -> None:
    found = unplugging(bench("netft"), 2)
    assert len(found.back_s) == 2 and found.leaked_threads == 0
