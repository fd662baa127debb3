"""The running cell as rounds see it: what forbids a round now, and how its mission is started."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from hal.plant import RoundSection
from service.access.actor import act_as, actor
from service.processes.supervisor import Supervisor
from service.tasks.lease import LeaseDesk
from service.tasks.model import Task
from service.tasks.store import TaskStore


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningCell:
    """Joins what rounds ask; see `service.rounds.keeper.Cell`.

    Attributes:
        is_active: returns whether the condition of an alarm holds.
        submit: starts a mission file by its name, with an idempotency key; raises as `Service.submit`.
    """

    supervisor: Supervisor
    lease: LeaseDesk
    tasks: TaskStore
    is_active: Callable[[str], bool]
    submit: Callable[[str, str], Task]

    def why_not(self, section: RoundSection) -> str | None:
        """Return why a round may not begin now; None if it may."""
        if not self.supervisor.is_ready:
            return "the cell is not running"
        latch = self.supervisor.latch.state()
        if latch.is_latched:
            return f"the software stop is latched ({latch.source})"
        holder = self.lease.holder()[0]
        if holder is not None:
            return f"{holder} holds the lease"
        moving = self.tasks.moving_for_others("")
        if moving is not None:
            return moving
        active = [name for name in section.forbidden_by if self.is_active(name)]
        return f"alarm {active[0]} forbids it" if active else None

    def begin(self, section: RoundSection, key: str) -> Task:
        """Start the mission of a round in the name of the round."""
        before = actor()
        act_as(f"round {section.name}")
        try:
            return self.submit(section.mission, key)
        finally:
            act_as(before)

    def with_key(self, key: str) -> Task | None:
        """Return the task that was started with a key, also by an earlier service; None if there is none."""
        return next((task for task in self.tasks.all() if task.key == key), None)
