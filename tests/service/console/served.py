"""A service of fakes with its console, and pages of a real browser, which the tests of the console share."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Error
from pydantic import BaseModel

from hal.config import load_cell
from hal.strict import Strict
from service.access.keys import KeyBook, Role
from service.exposure import Exposure
from service.operations import Operation, OperationContext
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.history.test_store import reading
from tests.service.verbs import OPERATIONS, EchoResult, HoldRequest, hold
from tests.service.waiting import eventually

SLIDER = """
[[objects]]
kind = "slider"
name = "setpoint"
label = "SETPOINT"
position_m = [0.0, -0.12]
travel_m = 0.1
limits = { high = 90.0 }
what_to_do = "slide it back"
scale = { minimum = 0.0, maximum = 100.0, unit = "%", at_min = -0.05, at_max = 0.05 }
"""


def until(page: Any, claim: str) -> None:
    """Wait until a JavaScript condition holds; one about an element that is not there yet does not hold."""
    probe = f"() => {{ try {{ return Boolean({claim}) }} catch {{ return false }} }}"

    def holds() -> bool:
        try:
            return bool(page.evaluate(probe))
        except Error:
            return False  # the page is being loaded again, after a restart of the console

    try:
        eventually(holds, timeout_s=60.0)
    except AssertionError:
        raise AssertionError(f"{claim}; the page says: {page.inner_text('body')}") from None


class SetRequest(Strict):
    """What the console asks for when a slider is set or read."""

    object: str = ""
    objects: tuple[str, ...] = ()
    value: float = 7.0


class MissionAsked(Strict):
    """What the console asks for on the page of missions."""

    file: str | None = None
    resume: str | None = None
    dry_run: bool = False


class MissionTold(BaseModel):
    """What a mission of this test tells."""

    plan: dict[str, Any] | None = None


def mission(context: OperationContext, request: MissionAsked) -> MissionTold:
    """Plan one station, or stand still until it is cancelled."""
    if request.dry_run:
        way = [[0.3, 0.0, 0.6], [0.4, 0.1, 0.5], [0.5, 0.1, 0.5]]
        station = {"step": "read", "what": "close-up of setpoint", "way_s": 1.5, "problem": None, "flange_m": way}
        times = {"ways_s": 1.5, "contact_s": 0.0, "expected_s": 1.5}
        return MissionTold(plan={"stations": [station], "is_possible": True, "located": True, **times})
    context.task.progress(0.1, "close-up", "setpoint")
    hold(context, HoldRequest())
    return MissionTold()


def _added(book: KeyBook, name: str, role: Role) -> str:
    return book.add(name, role, valid_s=None, commit=lambda _kind, _data: None)


class Cell:
    """A service of fakes with its console. A slider that is set or read is in the history afterwards."""

    def __init__(
        self,
        write_cell: WriteCell,
        folder: Path,
        *,
        keys: dict[str, Role] | None = None,
        exposure: Exposure | None = None,
    ) -> None:
        self.trouble = folder / "trouble"  # while it says so, the lights do not connect
        self.trouble.parent.mkdir(parents=True, exist_ok=True)
        self.trouble.write_text("" if keys else "away")
        path = write_cell(robot=True, options={"panel_lights": {"trouble": str(self.trouble)}})
        (path.parent / "panel.toml").write_text((path.parent / "panel.toml").read_text() + SLIDER)
        self.asked: list[SetRequest] = []
        holds = Operation(
            name="missions",
            request_model=MissionAsked,
            result_model=MissionTold,
            run=mission,
            summary="Hold",
            moves=True,
            can_pause=True,
            is_still=lambda request: request.dry_run,
        )
        sets = {
            verb: Operation(
                name=verb, request_model=SetRequest, result_model=EchoResult, run=self._set, summary="Set", moves=True
            )
            for verb in ("manipulate", "inspect")
        }
        runs = folder
        if exposure is not None:  # a service that others reach must have its keys before it starts
            book = KeyBook(runs / ".service" / "keys.json")
            self.secrets = {name: _added(book, name, role) for name, role in (keys or {}).items()}
        options = Options(
            port=0, runs_dir=runs, inline=True, partial=True, console=True, exposure=exposure or Exposure()
        )
        self.service = Panelwright(load_cell(path), options, operations={**OPERATIONS, "missions": holds, **sets})
        if exposure is None:
            book = self.service.service.keys
            self.secrets = {name: _added(book, name, role) for name, role in (keys or {}).items()}
        self.service.start()
        assert self.console.wait_until_ready(150.0)

    @property
    def console(self) -> Any:
        assert self.service.console is not None
        return self.service.console

    @property
    def url(self) -> str:
        return str(self.service.console_url)

    def _set(self, context: OperationContext, request: SetRequest) -> EchoResult:
        self.asked.append(request)
        context.task.progress(0.5, "sliding")
        self.record(request.value)
        return EchoResult(text="", number=request.value, nothing=None)

    def record(self, value: float) -> None:
        """Store a reading of the slider, and judge it by its limits."""
        given = {
            "object": "setpoint",
            "kind": "slider",
            "unit": "%",
            "sigma": 0.3,
            "confidence": 0.9,
            "utc_s": time.time(),
        }
        stored = reading(0, value, **given)
        plant = self.service.service.plant
        plant.history.add([stored])
        for listen in plant.observations.listeners:
            listen([stored])


def leave_mission(folder: Path, *, done: list[str]) -> None:
    """Write what an earlier mission leaves: a report, and how far it got."""
    folder.mkdir(exist_ok=True)  # of the same test, tried again
    told = {"started": "2026-01-03T00:00:00Z", "succeeded": False, "readings": [{"name": "setpoint"}], "actions": []}
    (folder / "report.json").write_text(json.dumps(told))
    (folder / "report.html").write_text("<h1>report</h1>")
    steps = [{"name": "read"}, {"name": "feel"}]
    (folder / "progress.json").write_text(json.dumps({"mission": {"title": "Look", "steps": steps}, "done": done}))
