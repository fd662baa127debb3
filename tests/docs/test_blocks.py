"""Every Python and shell block of the pages runs unchanged, or states why it does not."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.cell import clear_stop
from hal.config import load_cell
from service.client import Client
from service.serve import Options, Panelwright
from tests.docs.blocks import ROOT, Block, blocks, page_name

LEAST_REASON = 10  # characters
LIMIT_S = 240.0
LINKED = (".venv", "benchmarks", "cells", "docs", "examples", "missions", "panels")
BLOCKS = list(blocks())
RUN_PAGES = sorted({block.page for block in BLOCKS if not block.mark})


@pytest.mark.parametrize("block", [block for block in BLOCKS if block.mark], ids=lambda block: page_name(block.page))
def test_a_block_that_is_not_run_here_says_why_or_names_its_test(block: Block) -> None:
    if block.mark == "fragment":
        assert len(block.said) >= LEAST_REASON
        return
    path, _, name = block.said.partition("::")
    assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield a service on the bench cell, as `panelwright serve` starts it."""
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"))
    panelwright = Panelwright(load_cell(ROOT / "cells" / "bench.toml"), options)
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("page", RUN_PAGES, ids=page_name)
def test_the_blocks_of_a_page_run_one_after_the_other(
    page: Path, served: Panelwright, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if shutil.which("curl") is None:
        pytest.skip("curl is not installed")
    clear_stop(Client(url=served.url))  # the pages share a service, and each begins with a cell that may move
    for name in LINKED:
        if (ROOT / name).exists():
            (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    mine = [block for block in BLOCKS if block.page == page and not block.mark]
    shell = [
        commands(block.code) if block.language == "console" else block.code
        for block in mine
        if block.language != "python"
    ]
    run_shell(addressed("\n".join(shell), served), tmp_path)
    names: dict[str, Any] = {}
    for block in mine:
        if block.language == "python":
            exec(compile(addressed(block.code, served), page_name(page), "exec"), names)  # noqa: S102 - our own pages


def addressed(code: str, served: Panelwright) -> str:
    """Return the block with the addresses of the running service instead of the default ones."""
    api, stop = served.url, served.stop_url.removesuffix("/v1/stop")
    for usual, address in (("127.0.0.1:8460", api), ("localhost:8460", api), ("localhost:8461", stop)):
        code = code.replace(f"http://{usual}", address).replace(usual, address)
    return code


def commands(code: str) -> str:
    """Return the input of a terminal session: the lines after `$`."""
    return "\n".join(line[2:] for line in code.splitlines() if line.startswith("$ "))


def run_shell(script: str, folder: Path) -> None:
    """Run the shell blocks of a page, which must all succeed, with this environment's commands first on the path."""
    path = os.pathsep.join((str(Path(sys.executable).parent), os.environ["PATH"]))
    (folder / ".curlrc").write_text("fail-with-body\n", encoding="utf-8")  # an HTTP error status is a failure
    done = subprocess.run(
        ["bash", "-euxo", "pipefail", "-c", script],
        cwd=folder,
        env=os.environ | {"PATH": path, "CURL_HOME": str(folder)},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 0, f"{script}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
