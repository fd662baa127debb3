"""The published clients are those that the API gives, and they work: the Python client drives a service with a simulated cell."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from clients.generate import (
    COMPILER,
    MODELS_BY,
    PYTHON,
    TYPES,
    TYPES_BY,
    api_document,
    generated,
    head,
    without_named_choices,
)
from hal.config import load_cell
from service.serve import Options, Panelwright
from tests.service.outlets.node_packages import folder_of

ROOT = Path(__file__).parents[2]
COMMITTED = (PYTHON / "models.py", PYTHON / "calls.py", TYPES)


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Yield the address of a service with the simulated bench, inline."""
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True)
    panelwright = Panelwright(load_cell(ROOT / "cells/bench.toml", seed=71), options)
    panelwright.start()
    yield panelwright.url
    panelwright.close()


def test_the_clients_are_made_from_the_api_as_it_is() -> None:
    document = without_named_choices(api_document())
    for file in COMMITTED:
        first = file.read_text(encoding="utf-8").splitlines(keepends=True)[0]
        assert first == head(document, "//" if file is TYPES else "#"), "run `python -m clients.generate` and commit"


def test_what_is_committed_is_what_the_command_makes(tmp_path: Path) -> None:
    folder_of(*TYPES_BY.split("@"))
    uv = [
        sys.executable,
        "-m",
        "uv",
        "tool",
        "run",
        "--quiet",
        "--offline",
        "--from",
        MODELS_BY,
        "datamodel-codegen",
        "--version",
    ]
    if subprocess.run(uv, check=False, capture_output=True).returncode:
        pytest.skip(f"{MODELS_BY} is not installed: run `python -m clients.generate`")
    generated(tmp_path, online=False)
    for file in COMMITTED:
        assert (tmp_path / file.name).read_text() == file.read_text(encoding="utf-8"), file.name


def test_the_types_of_typescript_compile() -> None:
    package, version = COMPILER.split("@")
    compiler = folder_of(package, version) / "node_modules/.bin/tsc"
    example = ROOT / "clients/typescript/example.ts"
    told = subprocess.run(
        [compiler, "--noEmit", "--strict", "--target", "es2022", example], check=False, capture_output=True, text=True
    )
    assert told.returncode == 0, told.stdout


@pytest.mark.slow
def test_the_client_of_python_takes_the_lease_runs_a_mission_and_reads_the_history(
    url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(PYTHON.parent))
    from panelwright_client import Client, Refused
    from panelwright_client.models import InspectStep, MissionFile, MissionRequest

    with Client(url, timeout_s=120.0) as client:
        assert client.info().cell == "bench"
        with client.lease("a test") as grant:
            assert client.show_lease().holder == grant.holder == "a test"
            look = MissionFile(title="Look", steps=[InspectStep(kind="inspect", name="look", objects=["pressure"])])
            task = client.missions(MissionRequest(mission=look))
            events = list(client.events(task.id))
            ended = client.ended(task.id)
        assert ended.state == "succeeded", ended.problem
        assert events[-1]["state"] == "succeeded"
        assert client.show_lease().holder is None
        (reading,) = client.show_history("pressure", limit=1).readings
        assert reading.task == task.id
        assert reading.crop_url is not None
        assert client.fetch_crop("pressure", reading.crop_url.rpartition("/")[2]).startswith(b"\x89PNG")
        with pytest.raises(Refused, match="no task") as refused:
            client.show_task("0123456789abcdef")
        assert refused.value.problem.hint
