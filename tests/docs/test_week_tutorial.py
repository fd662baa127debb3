"""The tutorial "A week of rounds" is followed command by command, with one simulated day in place of the week."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from hal.config import load_cell
from service.serve import Options, Panelwright
from tests.docs.blocks import ROOT, Block, blocks

PAGE = ROOT / "docs/tutorials/a-week-of-rounds.md"
LIMIT_S = 400.0
WEEK, DAY = "panelwright demo --week", "panelwright demo --week --days 1"
SERVE = "panelwright serve --cell plant/cells/bench.toml --runs ."


class Reader:
    """Somebody who types the commands of the page, and starts the service where the page says so."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.served: Panelwright | None = None

    def follow(self, block: Block) -> str:
        """Do what a block says; returns what its commands print."""
        code = block.code.strip()
        if code == SERVE:
            options = Options(port=0, runs_dir=self.folder)
            self.served = Panelwright(load_cell(self.folder / "plant/cells/bench.toml"), options)
            self.served.start()
            return ""
        path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
        url = {} if self.served is None else {"PANELWRIGHT_URL": self.served.url}
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", code.replace(WEEK, DAY) + "\npwd > .folder"],
            cwd=self.folder,
            env={**os.environ, "PATH": path, "COLUMNS": "140", **url},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            check=False,
        )
        assert done.returncode == 0, f"{code}\n{done.stdout[-3000:]}\n{done.stderr[-2000:]}"
        self.folder = next(Path(file.read_text().strip()) for file in self.folder.rglob(".folder"))
        for file in self.folder.parents[1].rglob(".folder"):
            file.unlink()
        return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_tutorial_leads_to_an_alarm_a_review_and_a_trend(tmp_path: Path) -> None:
    begun = tmp_path / "a" / "b"  # the reader's folder is looked for in the two above it
    begun.mkdir(parents=True)
    reader = Reader(begun)
    page = [block for block in blocks() if block.page == PAGE]
    assert WEEK in page[0].code
    try:
        printed = [reader.follow(block) for block in page]
        assert reader.served is not None
        plant = reader.served.service.plant
        assert str(plant.alarms.get("flow.low").state) == "acknowledged"
        assert str(plant.alarms.get("pressure.high").state) == "normal"
        assert plant.review.waiting()[0] == 0
        assert {one.section.name for one in plant.rounds.prospects()} == {"morning", "patrol"}
    finally:
        if reader.served is not None:
            reader.served.close()
    told = "\n".join(printed)
    for words in (
        "morning fits panel bench",
        "21 of 21 checks hold",
        "pump_on",
        "clean the filter",
        "is answered: unreadable",
    ):
        assert words in told, words
    assert (reader.folder / "pressure.png").read_bytes().startswith(b"\x89PNG")
    assert list((reader.folder / "waiting").glob("*-flow.png"))
    assert "unreadable" in (reader.folder / "flow.csv").read_text()
