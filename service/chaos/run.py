"""Runs tasks on a service, breaks something in each, and judges by invariants what follows."""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Iterator
from contextlib import suppress

from hal.errors import CellError, DeviceUnavailable
from service.chaos.acks import Acks
from service.chaos.faults import Broken, ChaosFault, Scene
from service.chaos.judge import Judge
from service.chaos.options import ChaosOptions, Round
from service.chaos.plant import Plant
from service.chaos.watch import Watch
from service.client import FINAL
from service.schema.mission_results import REPORTING

START_S = 400.0  # the first start may compile kernels
BACK_S = 60.0  # a service that is not ready after this long counts as lost
END_S = 20.0  # a cancelled task ends within this time
STEP_S = 0.05


class Chaos:
    """A run on one plant.

    Args:
        arm: name of the arm in the cell file, whose joints are watched.
        devices: names of the devices that take injected faults.
    """

    def __init__(self, plant: Plant, options: ChaosOptions, *, arm: str, devices: tuple[str, ...]) -> None:
        self._plant = plant
        self._options = options
        self._acks = Acks(plant=plant)
        self._watch = Watch(plant=plant, arm=arm)
        self._random = random.Random(options.seed)
        self._scene = Scene(
            plant=plant, acks=self._acks, random=self._random, verb=options.verb, body=options.body, devices=devices
        )
        self._judge = Judge(plant, self._acks, self._watch)
        self.final = Round(number=0, fault="the whole run")

    def rounds(self, tell: Callable[[Round], None] = lambda _round: None) -> Iterator[Round]:
        """Yield the rounds as they end; afterwards `final` holds what the journal and the processes say in the end.

        Each fault comes once in random order before any comes again.
        """
        end_s = time.monotonic() + 60.0 * self._options.minutes
        self._watch.begin()
        try:
            for number, fault in enumerate(self._order(), 1):
                is_over = time.monotonic() > end_s if self._options.rounds is None else number > self._options.rounds
                if is_over:
                    break
                done = self._round(number, fault)
                tell(done)
                yield done
        finally:
            self._watch.end()
            self._finish()

    def _order(self) -> Iterator[ChaosFault]:
        while True:
            yield from self._random.sample(self._options.chosen(), len(self._options.chosen()))

    # -- one round ---------------------------------------------------------------------------------------------------

    def _round(self, number: int, fault: ChaosFault) -> Round:
        done = Round(number=number, fault=fault.name)
        delay_s = self._random.uniform(0.0, self._options.longest_s)
        has_lease = fault.name == "silence client" or self._random.random() < 0.5
        try:
            task_id = self._prepare(done, has_lease)
        except CellError as error:
            done.breaches.append(f"no task could begin: {error.type_name}: {error.what}")
            self._start_again(done)
            return done
        self._await(lambda: self._state(task_id) in FINAL, delay_s)
        broken = self._break(done, fault)
        begun_s = time.monotonic()
        try:
            self._await_consequences(done, fault, task_id, begun_s)
        finally:
            broken.undo()
        self._settle(done, fault, task_id)
        done.breaches += self._judge.of_round()
        self._await(lambda: not self._plant.survivors(), END_S)
        done.breaches += self._judge.of_orphans()
        return done

    def _prepare(self, done: Round, has_lease: bool) -> str:
        """Bring the service into a state in which a task can run; returns the id of the one that runs."""
        plant = self._plant
        if not plant.is_alive():
            plant.start()
        plant.await_ready(START_S if plant.life == 1 else BACK_S)
        plant.roles()
        if running := [task["id"] for task in plant.client().get("/v1/tasks")["tasks"] if task["state"] not in FINAL]:
            done.breaches.append(f"a task runs that nobody asked for in this life: {running[0]}")
        self._acks.reset()
        if has_lease:
            self._acks.take_lease()
        task_id = self._acks.begin_task(self._options.verb, self._options.body)
        self._await(lambda: self._state(task_id) in ("running", *FINAL), END_S)
        return task_id

    def _break(self, done: Round, fault: ChaosFault) -> Broken:
        try:
            broken = fault.begin(self._scene)
        except CellError as error:
            broken = Broken(what=f"not injected: {error.what}")
            if fault.name == "stop":
                done.breaches.append(f"a stop was not answered: {error.what}")
        done.what = broken.what
        if "; answered: " in broken.what:
            done.breaches.append(f"a broken request was not refused: {broken.what.rpartition(': ')[2]}")
        return broken

    def _await_consequences(self, done: Round, fault: ChaosFault, task_id: str, begun_s: float) -> None:
        """Wait until what must follow has followed, or the fault has lasted long enough; a stop must be possible meanwhile."""
        if fault.restarts or done.what.startswith("there was no"):
            return
        has_latched = has_ended = False

        def has_followed() -> bool:
            nonlocal has_latched, has_ended
            has_latched = has_latched or self._is_latched()
            has_ended = has_ended or self._state(task_id) in FINAL
            return (fault.latches or fault.ends) and has_latched >= fault.latches and has_ended >= fault.ends

        was_over = self._is_over(task_id, fault)
        if self._await(has_followed, self._options.patience * fault.lasts_s):
            done.followed_s = time.monotonic() - begun_s
        if fault.latches and not has_latched:
            done.breaches.append(f"the stop was not latched within {fault.lasts_s:.0f} s")
        lasted_s = time.monotonic() - begun_s
        if fault.ends and not was_over and not (has_ended and self._may_have_ended(task_id, fault, lasted_s)):
            done.breaches.append(f"the task went on for {lasted_s:.0f} s as if nothing had happened")
        if not fault.latches:
            self._stop_meanwhile(done, fault)

    def _may_have_ended(self, task_id: str, fault: ChaosFault, lasted_s: float) -> bool:
        """Return whether the fault explains how a task has ended: not by success, except before it acts."""
        return lasted_s < fault.acts_after_s or self._state(task_id) != "succeeded"

    def _is_over(self, task_id: str, fault: ChaosFault) -> bool:
        """Return whether a task has succeeded, or only its report is left, which a fault that ends motions need not end."""
        task = self._plant.state_of(task_id) or {}
        return task.get("state") == "succeeded" or (fault.latches and task.get("step") == REPORTING)

    def _stop_meanwhile(self, done: Round, fault: ChaosFault) -> None:
        """Stop at the stop port while the fault lasts, in every second round."""
        if self._random.random() < 0.5:
            return
        try:
            self._plant.stop_client().post("/v1/stop")
        except CellError as error:
            done.breaches.append(f"nobody could stop at the stop port during {fault.name!r}: {error.what}")

    def _settle(self, done: Round, fault: ChaosFault, task_id: str) -> None:
        """End the task, wait until the cell is back, and note how the task ended."""
        begun_s = time.monotonic()
        if fault.restarts:
            self._gone(done)
            self._plant.start()
        elif self._plant.is_alive():
            self._acks.release()
            if self._state(task_id) not in FINAL:
                with suppress(CellError):
                    self._plant.client().post(f"/v1/tasks/{task_id}/cancel", headers=self._acks.headers())
                if not self._await(lambda: self._state(task_id) in FINAL, END_S):
                    done.breaches.append(f"a cancelled task did not end within {END_S:.0f} s")
        try:
            self._plant.await_ready(BACK_S)
            if not self._await(self._can_read, BACK_S):
                raise DeviceUnavailable("the cell says that it runs, but its arm cannot be read", hint="see the log")
        except CellError as error:
            done.breaches.append(f"not back after {BACK_S:.0f} s: {error.what}")
            self._start_again(done)
        done.back_s = time.monotonic() - begun_s
        self._acks.release()
        self._judge.of_task(done, task_id)

    def _gone(self, done: Round) -> None:
        """Check that no process outlives the service."""
        self._await(lambda: not self._plant.is_alive() and not self._plant.survivors(), END_S)
        done.breaches += self._judge.of_orphans()

    def _start_again(self, done: Round) -> None:
        """End a service that does not work any more, and start it again for the next round."""
        with suppress(CellError):
            self._plant.end()
        self._gone(done)
        self._plant.sweep()
        self._acks.release()

    def _finish(self) -> None:
        """End the service and check what it leaves."""
        self._acks.release()
        with suppress(CellError):
            self._plant.end()
        if self._plant.life:
            self.final.breaches += [*self._judge.of_orphans(), *self._judge.of_round()]
        self._plant.sweep()

    # -- looks -------------------------------------------------------------------------------------------------------

    def _state(self, task_id: str) -> str:
        task = self._plant.state_of(task_id)
        return "" if task is None else str(task["state"])

    def _can_read(self) -> bool:
        """Return whether the arm answers: a cell whose simulated world is dead says that it runs."""
        try:
            self._plant.client(2.0).get(f"/v1/devices/{self._watch.arm}/reading")
        except CellError:
            return False
        return True

    def _is_latched(self) -> bool:
        for client in (self._plant.stop_client(1.0), self._plant.client(1.0)):
            with suppress(CellError):
                return bool(client.get("/v1/stop")["is_latched"])
        return False

    @staticmethod
    def _await(is_true: Callable[[], bool], within_s: float) -> bool:
        end_s = time.monotonic() + within_s
        while not is_true():
            if time.monotonic() > end_s:
                return False
            time.sleep(STEP_S)
        return True
