"""A generated driver passes the conformance tests unchanged; the example package is one in a separate package."""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drivers.scaffold import new_driver
from hal.devices import DeviceKind
from hal.errors import ConfigError
from service.cli import _app
from service.commissioning.new_driver import parse_kind, write_driver

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "driver-package"


TEMPLATES = {
    DeviceKind.PROXIMITY: "serial",
    DeviceKind.FORCE_TORQUE: "tcp",
    DeviceKind.TOUCH: "serial",
    DeviceKind.RANGE_SCANNER: "serial",
    DeviceKind.LIGHTS: "tcp",
}


def run_pytest(*folders: Path, beside: tuple[Path, ...] = ()) -> subprocess.CompletedProcess[str]:
    """Run the tests of packages that are not installed, in one process, because its start takes longer than they do.

    Args:
        beside: further folders on the import path.
    """
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*map(str, (*folders, *beside)), str(ROOT)])}
    options = ["-v", "-p", "no:cacheprovider", "-c", os.devnull, "--rootdir", str(folders[0].parent)]
    command = [sys.executable, "-m", "pytest", *options, *(str(folder / "tests") for folder in folders)]
    return subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=120)


def run_ruff(folder: Path) -> subprocess.CompletedProcess[str]:
    ruff = [
        str(Path(sys.executable).with_name("ruff")),
        "check",
        "--no-cache",
        "--config",
        str(ROOT / "pyproject.toml"),
    ]
    command = [*ruff, "--ignore", "I001,S101", str(folder)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.slow
def test_new_drivers_of_all_kinds_are_clean_and_pass_the_kit(tmp_path: Path) -> None:
    runner, folders = CliRunner(), []
    for kind, transport in TEMPLATES.items():
        folders.append(tmp_path / kind)
        arguments = ["new-driver", f"{kind}:acme_{kind}", "--transport", transport, "--folder", str(folders[-1])]
        told = runner.invoke(_app(), arguments)
        assert told.exit_code == 0, told.output
        written = {path.relative_to(folders[-1]): path.read_text() for path in folders[-1].rglob("*.*")}
        assert {"README.md", "pyproject.toml"} <= {str(path) for path in written}
        assert max(len(text.splitlines()) for text in written.values()) <= 120
    checked = run_ruff(tmp_path)
    assert checked.returncode == 0, checked.stdout
    done = run_pytest(*folders)
    assert done.returncode == 0, done.stdout[-3000:]
    for kind in TEMPLATES:
        assert f"test_acme_{kind}.py" in done.stdout


def test_in_this_tree_a_driver_has_its_places_and_is_registered(tmp_path: Path) -> None:
    (tmp_path / "drivers" / "emulators").mkdir(parents=True)
    project = tmp_path / "pyproject.toml"
    project.write_text((ROOT / "pyproject.toml").read_text())
    written = write_driver(DeviceKind.RANGE_SCANNER, "acme", transport="serial", folder=tmp_path, package=None)
    assert [str(path.relative_to(tmp_path)) for path in written.files] == [
        "drivers/acme.py",
        "drivers/emulators/acme.py",
        "tests/drivers/test_acme.py",
        "docs/driver_acme.md",
    ]
    points = tomllib.loads(project.read_text())["project"]["entry-points"]
    assert points["panelwright.devices"]["serial:acme"] == "drivers.acme:connect"
    assert points["panelwright.emulators"]["acme"] == "drivers.emulators.acme:start"
    with pytest.raises(ConfigError, match=r"drivers/acme\.py exists already"):
        write_driver(DeviceKind.RANGE_SCANNER, "acme", transport="tcp", folder=tmp_path, package=None)


def test_a_project_without_the_tables_says_what_to_do_and_nothing_is_written(tmp_path: Path) -> None:
    (tmp_path / "drivers" / "emulators").mkdir(parents=True)
    (tmp_path / "pyproject.toml").write_text("[project]\n")
    with pytest.raises(ConfigError, match="has no table") as caught:
        write_driver(DeviceKind.RANGE_SCANNER, "acme", transport="serial", folder=tmp_path, package=None)
    assert "by hand" in caught.value.hint
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["pyproject.toml"]


@pytest.mark.parametrize("name", ["Acme", "9a", "a-b", ""])
def test_a_name_that_is_no_module_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match="module name"):
        new_driver(name, DeviceKind.PROXIMITY)


@pytest.mark.parametrize("what", ["foo", "scanner:", "laser:foo"])
def test_what_is_no_kind_and_name_is_refused(what: str) -> None:
    with pytest.raises(ConfigError):
        parse_kind(what)
    assert parse_kind("scanner:foo") == (DeviceKind.RANGE_SCANNER, "foo")


def test_a_kind_or_transport_without_template_says_where_to_start() -> None:
    with pytest.raises(ConfigError, match="arm") as caught:
        new_driver("acme", DeviceKind.ARM)
    assert "proximity" in caught.value.hint
    with pytest.raises(ConfigError, match="pigeon"):
        new_driver("acme", DeviceKind.PROXIMITY, transport="pigeon")


def test_the_example_package_is_what_the_scaffold_writes() -> None:
    files = new_driver("rangefinder", DeviceKind.PROXIMITY, package="acme_rangefinder")
    for path, text in files.items():
        if path.name != "README.md":
            assert (EXAMPLE / path).read_text() == text, f"{path} differs: write it again with panelwright new-driver"


def test_the_example_package_registers_from_outside_and_passes_the_kit(tmp_path: Path) -> None:
    """The entry points of its pyproject are written by hand, in place of an installation by pip."""
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
    done = run_pytest(EXAMPLE, beside=(tmp_path,))
    assert done.returncode == 0, done.stdout[-3000:]
