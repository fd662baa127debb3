"""A scaffolded driver runs and passes the kit as it is written; the example package is one, registered from outside."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from drivers.scaffold import new_driver
from hal.devices import DeviceKind
from hal.errors import ConfigError

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "driver-package"


def run_pytest(folder: Path, *paths: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *map(str, paths), str(ROOT)])}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-p",
        "no:cacheprovider",
        "-c",
        os.devnull,
        "--rootdir",
        str(folder),
    ]
    return subprocess.run(
        [*command, str(folder / "tests")], check=False, env=environment, capture_output=True, text=True, timeout=120
    )


@pytest.mark.parametrize(
    ("kind", "transport"),
    [(DeviceKind.PROXIMITY, "serial"), (DeviceKind.FORCE_TORQUE, "tcp"), (DeviceKind.TOUCH, "serial")],
)
def test_a_new_driver_is_clean_and_passes_the_kit(kind: DeviceKind, transport: str, tmp_path: Path) -> None:
    files = new_driver("acme_one", kind, transport=transport, package="fresh", own_package=True)  # type: ignore[arg-type]
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    (tmp_path / "fresh" / "__init__.py").touch()
    ruff = Path(sys.executable).with_name("ruff")
    command = [str(ruff), "check", "--config", str(ROOT / "pyproject.toml"), "--no-cache", str(tmp_path / "fresh")]
    checked = subprocess.run([*command, "--ignore", "I001"], capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stdout
    done = run_pytest(tmp_path)
    assert done.returncode == 0, done.stdout[-3000:]
    assert max(len((tmp_path / path).read_text().splitlines()) for path in files) <= 120


@pytest.mark.parametrize("name", ["Acme", "9a", "a-b", ""])
def test_a_name_that_is_no_module_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="module name"):
        new_driver(name, DeviceKind.PROXIMITY)


def test_a_kind_without_template_says_where_to_start() -> None:
    with pytest.raises(ConfigError, match="arm") as caught:
        new_driver("acme", DeviceKind.ARM)
    assert "proximity" in caught.value.hint


def test_the_example_package_registers_from_outside_and_passes_the_kit(tmp_path: Path) -> None:
    """What pip would write is written by hand: the entry points of its pyproject."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    info = tmp_path / "acme_rangefinder-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {target}" for name, target in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))
    done = run_pytest(EXAMPLE, tmp_path)
    assert done.returncode == 0, done.stdout[-3000:]
