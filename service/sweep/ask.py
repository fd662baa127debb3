"""Asks the server of a random panel for its deeds, one by one or in one mission, and has the answers judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.geometry import UncertainPose, perturbed
from hal.panel import Panel
from hal.simulated import TrueContact, Truth
from service.client import FINAL, ApiError, Client
from service.evaluate import truth_of
from service.serve import Panelwright
from service.sweep.deeds import Deed, deeds_of
from service.sweep.judge import JudgedDeed, judge

KNOWN_SIGMA_M, KNOWN_SIGMA_RAD = 0.00065, 0.001  # per axis: what the border lights alone give, 1.1 mm and 0.1 degrees
WAIT_S = 20
NOTHING = {"confirmed": False, "attempts": 0, "peak_force_n": 0.0}

Answer = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class PanelRun:
    """The judged deeds of one panel; `problem` says why there are none, or why a mission ended early.

    `readings` holds how many readings of a mission were right, and how many were given.
    """

    seed: int
    deeds: tuple[JudgedDeed, ...]
    problem: str = ""
    readings: tuple[int, int] = (0, 0)
    cell_s: float = 0.0
    wall_s: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Asked:
    """The deeds that are asked of one panel: its server, its client, and the panel as built."""

    seed: int
    server: Panelwright
    client: Client
    panel: Panel
    deeds: tuple[Deed, ...]

    def one_by_one(self, tell: Callable[[str], None]) -> PanelRun:
        """Ask for one deed after the other, each judged when it has ended; `tell` gets a line for each."""
        judged: list[JudgedDeed] = []
        for deed in self.deeds:
            began_s = _truth(self.server).sim_time_s
            _clear_stop(self.client)
            answer = _said(_ended(self.client, "/v1/manipulate", deed.asked))
            truth = _truth(self.server, began_s)
            answer["cell_s"] = truth.sim_time_s - began_s
            judged.append(judge(self.seed, deed, self.panel, answer, truth))
            tell(judged[-1].line())
        return PanelRun(seed=self.seed, deeds=tuple(judged), cell_s=sum(deed.cell_s for deed in judged))

    def in_one_mission(self) -> PanelRun:
        """Order all deeds in one mission and judge them at its end; the peak of a deed is that on its control."""
        began_s = _truth(self.server).sim_time_s
        _clear_stop(self.client)
        task, refused = self._mission()
        truth = _truth(self.server, began_s)
        reports = self.client.get("/v1/missions")["missions"]
        if not reports:
            return PanelRun(seed=self.seed, deeds=(), problem=_said(task)["cause"])
        document = self.client.get(f"/v1/missions/{reports[0]['name']}/report.json")
        answers = {action["object"]: {**action, "cause": action["detail"]} for action in document["actions"]}
        answers |= refused
        early = {**NOTHING, "cell_s": 0.0, "outcome": "not-begun", "cause": _said(task)["cause"]}
        worked = frozenset(
            name for deed in self.deeds for name in (deed.object, self.panel.object(deed.object).shown_by)
        )
        judged = tuple(
            judge(self.seed, deed, self.panel, answers.get(deed.object, early), _on(deed.object, truth), worked=worked)
            for deed in self.deeds
        )
        verdict = _ended(self.client, "/v1/judge", {"mission": reports[0]["name"]})["result"] or {}
        return PanelRun(
            seed=self.seed,
            deeds=judged,
            problem="" if document["problem"] is None else document["problem"]["detail"],
            readings=(verdict.get("readings_right", 0), verdict.get("readings_given", 0)),
            cell_s=document["cell_s"],
        )

    def _mission(self) -> tuple[dict[str, Any], dict[str, Answer]]:
        """Run all deeds in one mission; deeds that are refused are left out, and returned as answers by object."""
        task = _ended(self.client, "/v1/missions", {"actions": [deed.asked for deed in self.deeds]})
        details = (task["problem"] or {}).get("details") or {}
        if not details.get("faults"):
            return task, {}
        refused = {name: {**_said(task), "cell_s": 0.0} for name in details["objects"]}
        rest = [deed.asked for deed in self.deeds if deed.object not in refused]
        return _ended(self.client, "/v1/missions", {"actions": rest}), refused


def asked_of(
    server: Panelwright, seed: int, *, known_pose: bool, is_wanted: Callable[[Deed], bool] = lambda _deed: True
) -> Asked:
    """Return the deeds on the panel of a running server."""
    first, cell = _truth(server), server.service.cell
    if known_pose:
        server.service.world.believe_panel(_nearly(first, seed))
    panel = cell.built_panel or cell.panel
    deeds = deeds_of(seed, panel, {item.name: item for item in first.objects})
    client = server.client(timeout_s=120.0)
    return Asked(seed=seed, server=server, client=client, panel=panel, deeds=tuple(filter(is_wanted, deeds)))


def _truth(server: Panelwright, began_s: float | None = None) -> Truth:
    """Return the truth, with the states at a simulated time (by default now) as `initial`."""
    connection = server.service.supervisor.connection
    now = truth_of(connection, 0.0)
    return now if began_s is None else truth_of(connection, now.sim_time_s - began_s)


def _on(name: str, truth: Truth) -> Truth:
    """Return a mission's truth with the peak of the force on one part; impulse and chatter of a part are not known."""
    peaks = truth.contact.peaks_n
    return replace(truth, contact=TrueContact(peak_n=peaks.get(name, 0.0), peaks_n=peaks))


def _nearly(truth: Truth, seed: int) -> UncertainPose:
    """Return the true pose of the panel with the error of a good measurement."""
    sigma = np.array([KNOWN_SIGMA_M] * 3 + [KNOWN_SIGMA_RAD] * 3)
    error = sigma * np.random.default_rng([seed, 1]).standard_normal(6)
    true = RigidTransform.from_matrix(truth.base_from_panel_matrix)
    return UncertainPose(parent_from_child=perturbed(true, error), covariance=np.diag(sigma**2))


def _clear_stop(client: Client) -> None:
    stop = client.get("/v1/stop")
    if stop["is_latched"]:
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})


def _ended(client: Client, path: str, body: dict[str, Any]) -> dict[str, Any]:
    """Start a task and return it when it has ended; a refusal is returned as a task that failed."""
    try:
        task: dict[str, Any] = client.post(path, body)
        while task["state"] not in FINAL:
            task = client.get(f"/v1/tasks/{task['id']}?wait_s={WAIT_S}")
    except ApiError as error:
        return {"state": "failed", "result": None, "problem": error.problem}
    return task


def _said(task: dict[str, Any]) -> Answer:
    """Return what the report of a deed says, or the problem with which its task ended."""
    if task["result"] is not None:
        action: Answer = task["result"].get("action", {})
        return {**NOTHING, **action, "cause": action.get("detail", "")}
    problem = task["problem"] or {"type": task["state"], "detail": ""}
    return {**NOTHING, "outcome": str(problem["type"]).rsplit(":", 1)[-1], "cause": str(problem["detail"])}
