"""The links, commands and shipped files in the pages exist, and the pages contain no paths of one machine."""

from __future__ import annotations

import re
import subprocess
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hal.config import load_cell
from hal.panel import PanelObject, load_panel
from hal.panel.kinds import KINDS
from service.cli import _app
from tests.docs import commands_page, driver_pages
from tests.docs.blocks import PAGES, ROOT, page_name

LINK = re.compile(r"\[[^\]]*\]\(([^)#]+)(?:#[^)]*)?\)")


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_every_link_leads_somewhere(page: Path) -> None:
    targets = [target for target in LINK.findall(page.read_text(encoding="utf-8")) if "://" not in target]
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert not missing


@pytest.mark.parametrize("path", sorted((ROOT / "cells").glob("*.toml")), ids=lambda path: path.name)
def test_every_shipped_cell_loads(path: Path) -> None:
    cell = load_cell(path)
    assert cell.panel.objects
    assert len(cell.file.workspace.park_rad) == (7 if "panda" in path.name else 6)


@pytest.mark.parametrize("path", sorted((ROOT / "panels").glob("*.toml")), ids=lambda path: path.name)
def test_every_shipped_panel_loads(path: Path) -> None:
    assert len(load_panel(path).lights) == 4


@pytest.mark.parametrize("point", entry_points(group=KINDS), ids=lambda point: point.name)
def test_the_page_of_the_panel_file_has_every_key_of_the_products_kinds(point: EntryPoint) -> None:
    if not point.module.startswith("hal."):
        pytest.skip("a kind of another package")
    page = (ROOT / "docs/reference/panel-file.md").read_text(encoding="utf-8")
    (row,) = re.findall(rf"^\| `{point.name}` \| (.*?) \|", page, re.MULTILINE)
    named = re.findall(r"`(\w+)`", re.sub(r"\([^)]*\)", "", row))
    own = set(point.load().model_fields) - set(PanelObject.model_fields)
    assert sorted(named) == sorted(own)


def test_every_command_that_the_pages_name_exists() -> None:
    known = CliRunner().invoke(_app(), ["--help"]).output
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    commands = set(re.findall(r"(?:`|bin/|^)panelwright ([a-z][a-z-]+)", text, flags=re.MULTILINE))
    assert {"serve", "demo", "doctor"} <= commands
    assert not {command for command in commands if f" {command} " not in known}


def test_the_page_of_commands_is_what_the_commands_say() -> None:
    written = commands_page.PAGE.read_text(encoding="utf-8")
    assert written == commands_page.text(), "run: python -m tests.docs.commands_page"


def test_the_options_and_the_table_of_drivers_are_what_models_and_records_say() -> None:
    remedy = "run: python -m tests.docs.driver_pages"
    assert driver_pages.OPTIONS.read_text(encoding="utf-8") == driver_pages.options_text(), remedy
    page = driver_pages.DRIVERS.read_text(encoding="utf-8")
    assert page == driver_pages.drivers_text(page), remedy


def test_every_page_is_in_the_site_and_every_entry_is_a_page() -> None:
    listed = set(
        re.findall(r": ([\w/.-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), flags=re.MULTILINE)
    )
    there = {page.relative_to(ROOT / "docs").as_posix() for page in (ROOT / "docs").rglob("*.md")}
    assert listed == there


def test_nothing_in_the_tree_names_a_machine_or_a_registry() -> None:
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout: which files belong to the tree is not known")
    forbidden = re.compile("|".join(("/work/" + "main", "/ro" + "ot/", r"pypi\." + "org", "python" + "hosted")))
    guilty = [
        name
        for name in tracked
        if Path(name).suffix in {".py", ".md", ".toml", ".txt", ".html", ".js", ".css"} or name == "Makefile"
        if forbidden.search((ROOT / name).read_text(encoding="utf-8", errors="replace"))
    ]
    assert not guilty
