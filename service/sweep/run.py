"""Runs the deeds of one random panel on a server of its own, through the HTTP API."""

from __future__ import annotations

import logging
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit
from scipy.spatial.transform import RigidTransform

from hal.config import Cell, load_cell
from hal.errors import CellError, InvalidRequest
from hal.geometry import UncertainPose, perturbed
from hal.simulated import Truth
from service.client import FINAL, ApiError, Client
from service.evaluate import truth_of
from service.serve import Options, Panelwright
from service.sweep.deeds import ROWS, Deed, deeds_of
from service.sweep.draw import NOMINAL, draw_panel
from service.sweep.judge import JudgedDeed, judge

KNOWN_SIGMA_M, KNOWN_SIGMA_RAD = 0.00065, 0.001  # per axis: what the border lights alone give, 1.1 mm and 0.1 degrees
WAIT_S = 20
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class SweepOptions:
    """What all panels of a sweep share.

    Attributes:
        cell: cell file that gives arm, sensors and workspace.
        only: kinds or rows to which the deeds are limited; empty for all.
        known_pose: whether the panel's pose is given, with the error that the border lights leave, instead of looked for.
        inline: whether the cell is in this process, which starts faster; the answers are the same.
    """

    cell: Path
    only: tuple[str, ...] = ()
    known_pose: bool = False
    inline: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelRun:
    """The judged deeds of one panel; `problem` says why there are none."""

    seed: int
    deeds: tuple[JudgedDeed, ...]
    problem: str = ""
    cell_s: float = 0.0
    wall_s: float = 0.0


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
            done = _deeds(seed, options, cell, panelwright, tell)
        except CellError as error:
            return PanelRun(seed=seed, deeds=(), problem=f"{error.type_name}: {error.what}")
        except Exception as defect:  # a defect on one panel must not cost the others
            log.exception("panel %d", seed)
            return PanelRun(seed=seed, deeds=(), problem=f"Defect: {type(defect).__name__}: {defect}")
        finally:
            panelwright.close()
    cell_s = sum(deed.cell_s for deed in done)
    return PanelRun(seed=seed, deeds=tuple(done), cell_s=cell_s, wall_s=time.monotonic() - started_s)


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


def _deeds(
    seed: int, options: SweepOptions, cell: Cell, panelwright: Panelwright, tell: Callable[[str], None]
) -> list[JudgedDeed]:
    client = Client(url=panelwright.url, timeout_s=120.0, is_lasting=False)
    first = _truth(panelwright)
    if options.known_pose:
        panelwright.service.world.believe_panel(_nearly(first, seed))
    assert cell.built_panel is not None  # noqa: S101 - narrowing: `write_files` states it
    judged = []
    for deed in deeds_of(seed, cell.built_panel, {item.name: item for item in first.objects}):
        if options.only and deed.kind not in options.only and deed.row not in options.only:
            continue
        began_s = _truth(panelwright).sim_time_s
        answer = _asked(client, deed)
        truth = _truth(panelwright, began_s)
        answer["cell_s"] = truth.sim_time_s - began_s
        judged.append(judge(seed, deed, cell.built_panel, answer, truth))
        tell(judged[-1].line())
    return judged


def _truth(panelwright: Panelwright, began_s: float | None = None) -> Truth:
    """Return the truth, with the states at a simulated time (by default now) as `initial`."""
    connection = panelwright.service.supervisor.connection
    now = truth_of(connection, 0.0)
    return now if began_s is None else truth_of(connection, now.sim_time_s - began_s)


def _nearly(truth: Truth, seed: int) -> UncertainPose:
    """Return the true pose of the panel with the error of a good measurement."""
    sigma = np.array([KNOWN_SIGMA_M] * 3 + [KNOWN_SIGMA_RAD] * 3)
    error = sigma * np.random.default_rng([seed, 1]).standard_normal(6)
    true = RigidTransform.from_matrix(truth.base_from_panel_matrix)
    return UncertainPose(parent_from_child=perturbed(true, error), covariance=np.diag(sigma**2))


def _asked(client: Client, deed: Deed) -> dict[str, Any]:
    """Ask for a deed and wait for its end; returns what the report says."""
    nothing = {"confirmed": False, "attempts": 0, "peak_force_n": 0.0}
    try:
        stop = client.get("/v1/stop")
        if stop["is_latched"]:
            client.post("/v1/stop/reset", {"seen_count": stop["count"]})
        task = client.post("/v1/manipulate", deed.body)
        while task["state"] not in FINAL:
            task = client.get(f"/v1/tasks/{task['id']}?wait_s={WAIT_S}")
    except ApiError as error:
        return {**nothing, "outcome": _type_of(error.problem), "cause": error.what}
    if task["result"] is None:
        problem = task["problem"] or {"type": task["state"], "detail": ""}
        return {**nothing, "outcome": _type_of(problem), "cause": problem["detail"]}
    action = task["result"]["action"]
    return {**action, "cause": action["detail"]}


def _type_of(problem: dict[str, Any]) -> str:
    return str(problem.get("type", "problem")).rsplit(":", 1)[-1]
