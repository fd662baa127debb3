"""Commands for people who write drivers: the scaffold fits its interface, and the kit runs on any cell."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from hal.devices import PROTOCOLS, DeviceKind
from hal.errors import ConfigError
from hal.registry import Context
from service.scaffold import driver_files
from tests.service.conftest import WriteCell

ROOT = Path(__file__).parents[2]


def _module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("scaffolded", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["scaffolded"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("kind", DeviceKind)
def test_a_new_driver_satisfies_its_interface_and_our_style(kind: DeviceKind, tmp_path: Path) -> None:
    files = driver_files("some_sensor", kind)
    assert list(files) == [Path("drivers/some_sensor.py"), Path("tests/drivers/test_some_sensor.py")]
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True)
        (tmp_path / path).write_text(text)
        # Arguments are unused until the driver is written; and first-party is told by folder, which is elsewhere here.
        command = [
            "ruff",
            "check",
            "--config",
            str(ROOT / "pyproject.toml"),
            "--ignore",
            "ARG002,I001",
            str(tmp_path / path),
        ]
        done = subprocess.run([sys.executable, "-m", *command], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
    module = _module(tmp_path / "drivers/some_sensor.py")
    device = module.connect(Context(name="finger"), {"port": "/dev/ttyUSB0"})
    assert isinstance(device, PROTOCOLS[kind])
    assert device.kind is kind
    device.close()
    device.close()
    assert not device.health().connected
    with pytest.raises(ConfigError, match=r"devices\.finger\.options.*prt"):
        module.connect(Context(name="finger"), {"port": "x", "prt": 1})


def test_the_kit_runs_on_a_cell_file(write_cell: WriteCell) -> None:
    path = write_cell()
    command = ["conform", str(path), "--device", "finger_proximity", "--level", "connect"]
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *command], capture_output=True, text=True, timeout=240, check=False
    )
    assert "Test_finger_proximity" in done.stdout
    assert "test_close_twice_is_once PASSED" in done.stdout
    assert "test_later_samples" not in done.stdout, "that is level read"


def test_the_kit_finds_a_broken_promise(write_cell: WriteCell) -> None:
    path = write_cell(options={"panel_lights": {"immortal": True}})
    command = ["conform", str(path), "--device", "panel_lights", "--level", "connect"]
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", *command], capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 1
    assert "test_after_close_every_read_says_unavailable FAILED" in done.stdout
