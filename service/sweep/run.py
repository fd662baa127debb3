"""Runs the deeds of one random panel on a server of its own, through the HTTP API."""

from __future__ import annotations

import logging
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path

import tomlkit

from hal.config import load_cell
from hal.errors import CellError, InvalidRequest
from service.serve import Options, Panelwright
from service.sweep.ask import PanelRun, asked_of
from service.sweep.deeds import ROWS, Deed
from service.sweep.draw import NOMINAL, draw_panel

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """What all panels of a sweep share.

    Attributes:
        cell: cell file that gives arm, sensors and workspace.
        only: kinds or rows to which the deeds are limited; empty for all.
        known_pose: whether the panel's pose is given, with the error that the border lights leave, instead of looked for.
        mission: whether all deeds are ordered in one mission, instead of one after the other.
        inline: whether the cell is in this process, which starts faster; the answers are the same.
    """

    cell: Path
    only: tuple[str, ...] = ()
    known_pose: bool = False
    inline: bool = False
    mission: bool = False

    def wants(self, deed: Deed) -> bool:
        """Return whether the sweep is about this deed."""
        return not self.only or deed.kind in self.only or deed.row in self.only


def chosen(text: str) -> tuple[str, ...]:
    """Return the kinds and rows in a list with commas.

    Raises:
        InvalidRequest: there is no such kind or row.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    known = (*NOMINAL, *ROWS)
    if wrong := [name for name in names if name not in known]:
        near = get_close_matches(wrong[0], known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise InvalidRequest(f"a sweep has no control {wrong[0]!r}", hint=hint)
    return names


def run_panel(seed: int, options: SweepOptions, tell: Callable[[str], None] = lambda _line: None) -> PanelRun:
    """Run and judge the deeds of the panel of a seed; `tell` gets a line for each of them."""
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="panelwright-sweep-") as folder:
        cell = load_cell(write_files(seed, options.cell, Path(folder)), seed=seed)
        panelwright = Panelwright(cell, Options(port=0, runs_dir=Path(folder) / "runs", inline=options.inline))
        try:
            panelwright.start()
            asked = asked_of(panelwright, seed, known_pose=options.known_pose, is_wanted=options.wants)
            done = asked.in_one_mission() if options.mission else asked.one_by_one(tell)
        except CellError as error:
            return PanelRun(seed=seed, deeds=(), problem=f"{error.type_name}: {error.what}")
        except Exception as defect:  # a defect on one panel must not cost the others
            log.exception("panel %d", seed)
            return PanelRun(seed=seed, deeds=(), problem=f"Defect: {type(defect).__name__}: {defect}")
        finally:
            panelwright.close()
    return replace(done, wall_s=time.monotonic() - started_s)


def write_files(seed: int, base: Path, folder: Path) -> Path:
    """Write the panel as stated, the panel as built and the cell into a folder; returns the path of the cell file."""
    drawn, loaded = draw_panel(seed), load_cell(base)
    for name, table in (("panel", drawn.stated), ("built", drawn.built)):
        (folder / f"{name}.toml").write_text(tomlkit.dumps(table), encoding="utf-8")
    table = tomllib.loads(base.read_text(encoding="utf-8"))
    table["cell"] |= {
        "panel": str((folder / "panel.toml").resolve()),
        "calibrations": str(loaded.calibration_path("any").parent.resolve()),
    }
    if loaded.knowledge_path is not None:
        table["cell"]["knowledge"] = str(loaded.knowledge_path.resolve())
    built = {"built_panel": str((folder / "built.toml").resolve())}
    table["simulation"] = {**table.get("simulation", {}), **drawn.simulation, **built}
    path = folder / "cell.toml"
    path.write_text(tomlkit.dumps(table), encoding="utf-8")
    return path
