"""Each planted defect still applies exactly once, and its tests exist; `make test-planted` runs them."""

from __future__ import annotations

import re

import pytest

from tests.planted.defects import ROOT, Defect, all_defects


def _name(defect: Defect) -> str:
    return defect.name.replace(" ", "-")


@pytest.mark.parametrize("defect", all_defects(), ids=_name)
def test_a_planted_defect_applies_and_its_tests_exist(defect: Defect) -> None:
    """Adapt `tests/planted/defects.toml` when a line that it plants a defect in has changed."""
    source = (ROOT / defect.file).read_text(encoding="utf-8")
    assert defect.planted(source) != source
    for test in defect.tests:
        path, _, rest = test.partition("::")
        text = (ROOT / path).read_text(encoding="utf-8")
        for name in filter(None, rest.partition("[")[0].split("::")):
            assert re.search(rf"\b(def {name}|class {name}|{name} =)\b", text), f"{path} has no {name}"


def test_there_are_enough_of_them_and_none_twice() -> None:
    names = [defect.name for defect in all_defects()]
    assert len(names) == len(set(names)) >= 40
