"""The links, commands and shipped files in the pages exist, and the pages contain no paths of one machine."""

from __future__ import annotations

import ast
import re
import subprocess
from collections.abc import Iterable, Iterator
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import pytest
import typer.main

from hal.config import load_cell
from hal.panel import PanelObject, load_panel
from hal.panel.kinds import KINDS
from service.cli import _app
from service.client import for_service
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


def _written_commands() -> set[str]:
    """Return the command lines of all pages, and those that messages and docstrings of the sources name in backticks."""
    pages = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    lines = re.findall(r"^(?:\.venv/bin/)?panelwright ([a-z][^\n#>|&]*)", pages, flags=re.MULTILINE)
    return {" ".join(line.split()) for line in [*lines, *_quoted([pages, *_messages()])]}


def _messages() -> Iterator[str]:
    """Yield the messages and docstrings of the sources that may name a command; a value in one is a space."""
    for room in ("drivers", "hal", "manipulation", "perception", "service", "simbackend"):
        for path in (ROOT / room).rglob("*.py"):
            source = path.read_text(encoding="utf-8")
            for node in ast.walk(ast.parse(source)) if "`panelwright " in source else ():
                if isinstance(node, ast.JoinedStr):
                    yield "".join(str(v.value) if isinstance(v, ast.Constant) else " " for v in node.values)
                elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                    yield node.value


def _quoted(texts: Iterable[str]) -> list[str]:
    return [found for text in texts for found in re.findall(r"`(?:\.venv/bin/)?panelwright ([a-z][^`]*)`", text)]


def _unknown(command: Any, words: list[str]) -> str | None:
    """Return the first command or option of a command line that does not exist; `…` stands for any."""
    known = set[str]()
    while True:
        known |= {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        if not hasattr(command, "commands") or not words or words[0].startswith(("-", "…")):
            break
        if words[0] not in command.commands:
            return words[0]
        command = command.commands[words.pop(0)]
    options = (word.partition("=")[0].rstrip(",;:") for word in words if word.startswith("--"))
    return next((option for option in options if option not in {*known, "--help", "--"}), None)


def test_every_command_that_pages_and_messages_name_exists_with_its_options() -> None:
    commands, panelwright = _written_commands(), typer.main.get_command(_app())
    assert {"serve", "demo", "doctor"} <= {line.split()[0] for line in commands}
    unknown = {line: _unknown(panelwright, line.split()) for line in commands}
    assert not {line: word for line, word in unknown.items() if word is not None}


def _commands(command: Any, words: str = "") -> Iterator[tuple[str, set[str]]]:
    """Yield each command that can be run, and its options."""
    if not hasattr(command, "commands") or command.invoke_without_command:
        yield words, {option for parameter in command.params for option in parameter.opts}
    for name, part in getattr(command, "commands", {}).items():
        yield from _commands(part, f"{words} {name}".lstrip())


def test_every_command_in_a_hint_gets_the_address_of_its_service_if_it_takes_one() -> None:
    """A hint without `--url` would send people to another service, and one command would refuse the option."""
    takes_url = {words: "--url" in options for words, options in _commands(typer.main.get_command(_app()))}
    hinted = {" ".join(line.split()) for line in _quoted(_messages())}
    for line in [*takes_url, *hinted]:
        known = [words for words in takes_url if f"{line} ".startswith(f"{words} ")]
        if not known:
            continue  # such as `panelwright task …`, which stands for several commands
        expected = takes_url[max(known, key=len)] and not re.search("--(url|cell)", line)
        given = for_service(f"`panelwright {line}`", "http://127.0.0.1:9000")
        assert ("--url http://127.0.0.1:9000`" in given) == expected, line


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
