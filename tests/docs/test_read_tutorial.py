"""The tutorial about photographs prints what it says, and its code runs."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from service.cli import _app
from tests.docs.blocks import ROOT
from tests.docs.test_examples import run

PAGE = "tutorials/read-a-photograph.md"


def test_the_page_prints_what_it_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "docs").symlink_to(ROOT / "docs")
    monkeypatch.chdir(tmp_path)
    text = (ROOT / "docs" / PAGE).read_text(encoding="utf-8")
    steps = re.findall(r"```bash\n(.*?)```\s+```text\n(.*?)```", text, flags=re.DOTALL)
    assert len(steps) == 3
    for commands, said in steps:
        for command, line in zip(commands.splitlines(), said.splitlines(), strict=True):
            told = CliRunner().invoke(_app(), shlex.split(command)[1:])
            assert " ".join(told.output.split()) == " ".join(line.split())
            assert told.exit_code == (1 if line.startswith("cannot tell") else 0)
    assert (tmp_path / "read.png").is_file()


def test_the_python_code_reads_both_pointers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    found = run(PAGE)["found"]
    assert "two pointers" in found.reason
    values = {pointer.colour: pointer.value for pointer in found.pointers}
    assert values["black"] == pytest.approx(162.4, abs=1.0)
    assert values["red"] == pytest.approx(106.4, abs=1.0)
    assert (found.scale.minimum, found.scale.maximum) == (0.0, 200.0)
