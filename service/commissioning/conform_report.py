"""Reports the results of the conformance tests per device and promise, as Markdown and as JSON."""

from __future__ import annotations

import json
import platform
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from hal.config import Cell
from hal.errors import ConfigError
from service.jsonable import jsonable

WORST_FIRST = ("failed", "skipped", "not tried", "passed")


@dataclass(frozen=True, slots=True, kw_only=True)
class PromiseResult:
    """The result of one promise of one device.

    Attributes:
        outcome: passed, failed, skipped (could not be tested here) or not tried (not requested, or interrupted before).
        why: the reason of every outcome except passed.
        link: what the device reported about its connection.
    """

    device: str
    promise: str
    level: str
    outcome: str
    took_s: float
    why: str = ""
    link: str = ""


class Notebook:
    """A pytest plugin that skips the promises above a level and records the results of the others."""

    def __init__(self, level: str) -> None:
        self.level = level
        self.findings: list[PromiseResult] = []
        self.is_stopped = False
        self._levels: dict[str, str] = {}
        self._open: list[str] = []

    def pytest_configure(self, config: Any) -> None:
        """Register the marker."""
        config.addinivalue_line("markers", "conformance(level): level of a promise")

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        """Deselect the tests above the level."""
        from hal.conformance import LEVELS

        order = [str(level) for level in LEVELS]
        above = []
        for item in items:
            mark = item.get_closest_marker("conformance")
            self._levels[item.nodeid] = level = str(mark.args[0]) if mark else order[0]
            if order.index(level) > order.index(self.level):
                above.append(item)
                why = f"level {level} was not requested"
                self._note(item.nodeid, "not tried", 0.0, why, "")
        config.hook.pytest_deselected(items=above)
        items[:] = [item for item in items if item not in above]
        self._open = [item.nodeid for item in items]

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Record one phase of a test: its call, or a set-up or tear-down that failed."""
        if report.when != "call" and report.outcome == "passed":
            return
        link = str(dict(report.user_properties).get("link", ""))
        self._note(report.nodeid, report.outcome, report.duration, _why(report), link)

    def pytest_keyboard_interrupt(self) -> None:
        """Note Ctrl-C, so that the report lists the remaining tests as not tried."""
        self.is_stopped = True
        for node in self._open:
            self._note(node, "not tried", 0.0, "interrupted by Ctrl-C before", "")

    def _note(self, node: str, outcome: str, took_s: float, why: str, link: str) -> None:
        self._open = [other for other in self._open if other != node]
        _, class_name, test = node.split("::")
        self.findings.append(
            PromiseResult(
                device=class_name.removeprefix("Test_"),
                promise=test.removeprefix("test_").replace("_", " "),
                level=self._levels[node],
                outcome=outcome,
                took_s=took_s,
                why=why,
                link=link,
            )
        )


def _why(report: Any) -> str:
    """Return one line: the reason of a skip, or the last line of a failure."""
    if report.outcome == "passed":
        return ""
    if report.outcome == "skipped":
        return str(report.longrepr[2]).removeprefix("Skipped: ")
    crash = getattr(report.longrepr, "reprcrash", None)
    text = str(report.longrepr if crash is None else crash.message)
    return f"{'' if report.when == 'call' else f'{report.when}: '}{text.strip().splitlines()[0]}"


def write_report(stem: Path, cell: Cell, devices: Sequence[str], notebook: Notebook) -> tuple[Path, Path]:
    """Write `STEM.md` and `STEM.json`; returns their paths.

    Raises:
        ConfigError: the files cannot be written.
    """
    found = as_data(cell, devices, notebook)
    paths = stem.with_name(f"{stem.name}.md"), stem.with_name(f"{stem.name}.json")
    try:
        stem.parent.mkdir(parents=True, exist_ok=True)
        paths[0].write_text(as_markdown(found), encoding="utf-8")
        paths[1].write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{stem}: the report cannot be written: {error}", hint="choose another --report") from error
    return paths


def as_data(cell: Cell, devices: Sequence[str], notebook: Notebook) -> dict[str, Any]:
    """Return all results as plain JSON values."""
    by_device = {name: [f for f in notebook.findings if f.device == name] for name in devices}
    return {
        "schema": 1,
        "cell": cell.name,
        "mode": cell.file.cell.mode,
        "file": cell.path.name,
        "seed": cell.file.cell.seed,
        "level": notebook.level,
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "panelwright": version("panelwright"),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "counts": Counter(f.outcome for f in notebook.findings),
        "devices": {name: _device(cell, name, findings) for name, findings in by_device.items()},
    }


def _device(cell: Cell, name: str, findings: list[PromiseResult]) -> dict[str, Any]:
    section = cell.file.devices[name]
    emulator = cell.file.emulators.get(name)
    return {
        "kind": str(section.kind),
        "driver": section.driver,
        "emulator": None if emulator is None else emulator.emulator,
        "link": next((f.link for f in findings if f.link), ""),
        "counts": Counter(f.outcome for f in findings),
        "promises": [
            {key: value for key, value in jsonable(f).items() if key not in ("device", "link")} for f in findings
        ],
    }


def as_markdown(found: dict[str, Any]) -> str:
    """Return the results as Markdown: a table of devices, then per device what did not pass, and last what passed."""
    lines = [
        f"# Conformance of cell {found['cell']}",
        "",
        f"{found['file']}, mode {found['mode']}, seed {found['seed']}, up to level *{found['level']}*. "
        f"panelwright {found['panelwright']}, Python {found['python']}, {found['machine']}, {found['written']}.",
        "",
        "| device | kind | driver | far side | passed | failed | skipped | not tried |",
        "| --- | --- | --- | --- | ---: | ---: | ---: | ---: |",
    ]
    for name, device in found["devices"].items():
        counts = [str(device["counts"].get(key, 0)) for key in ("passed", "failed", "skipped", "not tried")]
        far_side = f"emulator {device['emulator']}" if device["emulator"] else "as connected"
        lines.append(f"| {' | '.join([name, device['kind'], device['driver'], far_side, *counts])} |")
    for name, device in found["devices"].items():
        link = "without a wire" if device["counts"].get("passed") else "did not connect"
        lines += ["", f"## {name}", "", _cell_text(device["link"]) or link]
        lines += ["", "| promise | level | outcome | s | why |", "| --- | --- | --- | ---: | --- |"]
        for p in sorted(device["promises"], key=lambda p: WORST_FIRST.index(p["outcome"])):
            row = [p["promise"], p["level"], p["outcome"], f"{p['took_s']:.2f}", _cell_text(p["why"])]
            lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines) + "\n"


def _cell_text(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")
