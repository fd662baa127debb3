"""Keeps the newest answers of the service for all browsers together, so that ten of them ask no more often than one."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from nicegui import Event

from hal.errors import CellError
from hal.panel import Panel
from service.access.keys import Role
from service.client import FINAL, ApiError
from service.console.service_client import QUICK_S, ServiceClient

TICK_S = 0.25
IDLE_S = 15.0  # nobody has looked for so long: do not ask
LEFT_S = 600.0  # nobody has looked for so long: whoever looked has left
ROBOT_S = 2.0  # nobody has looked at the robot for so long: its stream is closed
MOST_ASKED = 3  # at once: more answers in one turn of the service's event loop would keep others waiting
FEED_S = 10.0  # so long does the service keep a question for new readings and alarms
PERIODS_S = {
    "ready": 1.0, "tasks": 0.5, "history": 5.0, "alarms": 5.0, "devices": 2.0, "frames": 1.0, "lease": 2.0,
    "stop": 1.0, "missions": 5.0, "mission_files": 10.0, "rounds": 2.0, "review": 2.0,
    "calibrations": 10.0, "info": 10.0, "panel": 10.0, "arm_model": 30.0, "scanner_model": 30.0,
}  # fmt: skip
PATHS = {
    "ready": "/readyz", "tasks": "/v1/tasks?limit=30", "history": "/v1/history", "alarms": "/v1/alarms",
    "devices": "/v1/devices", "frames": "/v1/frames", "lease": "/v1/lease", "stop": "/v1/stop", "missions": "/v1/missions",
    "mission_files": "/v1/mission-files", "rounds": "/v1/rounds", "review": "/v1/review?limit=100",
    "calibrations": "/v1/calibrations", "info": "/v1/info", "panel": "/v1/panel",
}  # fmt: skip
MODELS = {"arm_model": ("arm", "arm"), "scanner_model": ("range_scanner", "range_scanner")}
UNAUTHENTICATED = 401
T = TypeVar("T")
V = TypeVar("V")
ON_DEMAND = ("arm_model", "scanner_model", "mission_files", "rounds", "review")


@dataclass(frozen=True, slots=True, kw_only=True)
class Person:
    """Who looks; `name` is that of the key, None while the service has no keys."""

    name: str | None
    role: Role


ANYBODY = Person(name=None, role=Role.MAINTAINER)


def _panel_of(plain: Any) -> Panel:
    return Panel.model_validate_json(json.dumps(plain))


class Mirror:
    """What the service said last to one person, by topic, and the events of the tasks that run.

    It can be thrown away at any time.

    Attributes:
        person: in whose session the client asks; the service decides what this person may do, and pages offer no more.
        problem: why the service could not be asked; None when it answers.
        events: events of a task by its id, from its beginning.
        version: rises whenever the service says something that it has not said before.
        robot_told: fires with each state of the robot that the service streams; while a page follows it, the stream stays open.
    """

    def __init__(self, client: ServiceClient, *, person: Person = ANYBODY) -> None:
        self.client = client
        self.person = person
        self.problem: CellError | None = None
        self.events: dict[str, list[dict[str, Any]]] = {}
        self.version = 0
        self.robot_told: Event[[]] = Event()
        self._said: dict[str, Any] = {}
        self._due_s: dict[str, float] = {}
        self._looked_s = time.monotonic()
        self._wanted_s: dict[str, float] = {}
        self._followers: dict[str, asyncio.Task[None]] = {}
        self._computed: dict[str, tuple[Any, Any]] = {}
        self._robot: dict[str, Any] | None = None
        self._robot_wanted_s = -IDLE_S
        self._loops: list[asyncio.Task[None]] = []
        self._asking: set[asyncio.Task[None]] = set()
        self._slots = asyncio.Semaphore(MOST_ASKED)

    def start(self) -> None:
        """Begin to ask, in the running event loop."""
        self._loops = [asyncio.create_task(work()) for work in (self._run, self._listen, self._watch_robot)]

    def close(self) -> None:
        """End all requests."""
        for task in [*self._loops, *self._followers.values(), *self._asking]:
            task.cancel()

    def may(self, needed: Role) -> bool:
        """Return whether the role of the person permits what needs this role."""
        return self.person.role.permits(needed)

    @property
    def is_left(self) -> bool:
        """Whether nobody has looked for a long time, and no task needs to be followed."""
        is_following = any(not one.done() for one in self._followers.values())
        return not is_following and time.monotonic() - self._looked_s > LEFT_S

    @property
    def _is_watched(self) -> bool:
        """Whether somebody has looked lately."""
        return time.monotonic() - self._looked_s < IDLE_S

    @property
    def must_log_in(self) -> bool:
        """Whether the session has ended."""
        return isinstance(self.problem, ApiError) and self.problem.problem.get("status") == UNAUTHENTICATED

    def said(self, topic: str, otherwise: Any = None) -> Any:
        """Return the newest answer of a topic; a topic that only some pages need is asked for while they do."""
        self._looked_s = self._wanted_s[topic] = time.monotonic()
        return self._said.get(topic, otherwise)

    @property
    def robot(self) -> dict[str, Any] | None:
        """What the arm does, as `WS /v1/stream` tells it 20 times a second while somebody looks; None before."""
        self._looked_s = self._robot_wanted_s = time.monotonic()
        return self._robot

    @property
    def planned(self) -> dict[str, Any] | None:
        """The newest dry run that has a plan, unless something has moved the arm since."""
        for task in self.tasks:
            if task["request"].get("dry_run"):
                result = task["result"]
                if result is not None and result.get("plan") is not None:
                    return task
            elif task["moves"]:
                return None
        return None

    @property
    def panel(self) -> Panel | None:
        """The panel of the cell; None until the service has answered."""
        plain = self.said("panel")
        return None if plain is None else self.computed("panel", plain, _panel_of)

    def computed(self, name: str, said: T, compute: Callable[[T], V]) -> V:
        """Return what a function makes of something said, computed once for all pages until something else is said."""
        kept = self._computed.get(name)
        if kept is None or kept[0] is not said:
            self._computed[name] = kept = (said, compute(said))
        result: V = kept[1]
        return result

    @property
    def tasks(self) -> list[dict[str, Any]]:
        """The kept tasks, newest first."""
        found: list[dict[str, Any]] = self.said("tasks", {"tasks": []})["tasks"]
        return found

    @property
    def active(self) -> dict[str, Any] | None:
        """The task that runs or waits; None if nothing does."""
        return next((task for task in self.tasks if task["state"] not in FINAL), None)

    def readings(self) -> dict[str, dict[str, Any]]:
        """Return the newest reading of each object, by its name."""
        return {one["object"]: one for one in self.said("history", {"newest": []})["newest"]}

    def alarms(self) -> dict[str, dict[str, Any]]:
        """Return the first alarm of each object that has one, by its name."""
        found: dict[str, dict[str, Any]] = {}
        for alarm in self.said("alarms", {"alarms": []})["alarms"]:
            found.setdefault(alarm["object"], alarm)
        return found

    def hurry(self) -> None:
        """Ask for everything at the next tick, because something was done."""
        self._due_s.clear()

    async def ask_now(self, *topics: str) -> None:
        """Ask for some topics and wait for the answers, because a page must show what was just changed."""
        await asyncio.gather(*(self._ask(topic) for topic in topics))

    async def _run(self) -> None:
        while True:
            now_s = time.monotonic()
            if self._is_watched:
                for topic in self._topics_due(now_s):
                    self._due_s[topic] = now_s + QUICK_S + 1.0  # not again before it has answered
                    task = asyncio.create_task(self._ask(topic))
                    self._asking.add(task)
                    task.add_done_callback(self._asking.discard)
            await asyncio.sleep(TICK_S)

    async def _listen(self) -> None:
        """Take readings and changes of alarms as soon as they are recorded, without waiting for the next question."""
        known = ""
        while True:
            if not self._is_watched:
                known = ""  # what came meanwhile is asked for by topic
                await asyncio.sleep(TICK_S)
                continue
            try:
                found = await self.client.get(f"/v1/feed?wait_s={FEED_S}{known}", timeout_s=FEED_S + QUICK_S)
            except CellError:
                await asyncio.sleep(QUICK_S)
                continue
            known = f"&readings_after={found['readings_after']}&alarms_after={found['alarms_after']}"
            self._take(found["readings"])
            if found["alarms"]:
                await self._ask("alarms")

    async def _watch_robot(self) -> None:
        """Keep the newest state of the robot while a page shows it; the other pages are not renewed for it."""
        while True:
            if self._wants_robot:
                async with contextlib.aclosing(self.client.robot()) as samples:
                    async for sample in samples:
                        self._robot = sample
                        self.robot_told.emit()
                        if not self._wants_robot:
                            break
            self._robot = None
            await asyncio.sleep(TICK_S)

    @property
    def _wants_robot(self) -> bool:
        return bool(self.robot_told.callbacks) or time.monotonic() - self._robot_wanted_s < ROBOT_S

    def _take(self, readings: list[dict[str, Any]]) -> None:
        """Put new readings in the place of older ones of the same objects."""
        before = self._said.get("history")
        if before is None or not readings:
            return
        newest = {one["object"]: one for one in [*before["newest"], *sorted(readings, key=lambda one: one["id"])]}
        self._keep("history", {**before, "newest": list(newest.values())})

    def _keep(self, topic: str, answer: Any) -> None:
        self.version += self._said.get(topic) != answer
        self._said[topic] = answer

    def _topics_due(self, now_s: float) -> list[str]:
        return [
            topic
            for topic in PERIODS_S
            if now_s >= self._due_s.get(topic, 0.0)
            and (topic not in ON_DEMAND or now_s - self._wanted_s.get(topic, -IDLE_S) < IDLE_S)
        ]

    async def _ask(self, topic: str) -> None:
        try:
            async with self._slots:
                answer = await self.client.get(self._path(topic), timeout_s=QUICK_S)
            self._keep(topic, answer)
            self.version += self.problem is not None
            self.problem = None
        except CellError as error:
            if topic in ("info", "ready"):  # a single topic may be refused, for example an arm that is missing
                self.problem, self.version = error, self.version + 1
                if self.must_log_in:
                    self._said.clear()
        finally:
            self._due_s[topic] = time.monotonic() + PERIODS_S[topic]
        if topic == "tasks":
            self._follow_active()

    def _path(self, topic: str) -> str:
        if topic in PATHS:
            return PATHS[topic]
        kind, usual = MODELS[topic]
        devices = self._said.get("devices", {"devices": []})["devices"]
        return f"/v1/devices/{next((one['name'] for one in devices if one['kind'] == kind), usual)}"

    def _follow_active(self) -> None:
        for task in self._said.get("tasks", {"tasks": []})["tasks"][:5]:
            if task["id"] not in self.events:
                self.events[task["id"]] = []
                self._followers[task["id"]] = asyncio.create_task(self._follow(task["id"]))
        for old in list(self.events)[:-30]:
            self.events.pop(old)
            follower = self._followers.pop(old, None)
            if follower is not None:
                follower.cancel()

    async def _follow(self, task_id: str) -> None:
        with contextlib.suppress(CellError):
            async for event in self.client.events(task_id):
                self.events.setdefault(task_id, []).append(event)
        self.hurry()  # its readings are new
