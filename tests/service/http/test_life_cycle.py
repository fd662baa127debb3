"""Stops, resets, leases and tasks in any order, over HTTP, against a model of a dozen lines.

`python -m pytest -n 0 tests/service/http/test_life_cycle.py --timeout 0 --hypothesis-profile=long` makes 100 000 steps.
"""

from __future__ import annotations

from typing import Any

import httpx2
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule, run_state_machine_as_test

from service.serve import Panelwright

NAMES = st.sampled_from(["alice", "bob"])
PICK = st.integers(0, 3)
MOST = 8  # tasks of one client that may wait
IS_LONG = settings.get_current_profile_name() == "long"
LIMITS = settings(
    max_examples=2000 if IS_LONG else 25,
    stateful_step_count=50 if IS_LONG else 30,
    deadline=None,
    suppress_health_check=list(HealthCheck),
    phases=[Phase.generate, Phase.shrink] if IS_LONG else [Phase.generate],  # shrinking takes minutes
)


class Life(RuleBasedStateMachine):
    """A cell, with everything that its clients were told."""

    def __init__(self, client: httpx2.Client, served: Panelwright) -> None:
        super().__init__()
        self.client = client
        self.tasks = served.service.tasks
        self.is_latched = False
        self.counts = [client.get("/v1/stop").json()["count"]]
        self.holder: str | None = None
        self.tokens: list[str] = []
        self.begun: dict[str, str | None] = {}  # running and queued tasks, and who held the lease then

    def headers(self, pick: int) -> tuple[dict[str, str], bool]:
        """Return the headers of a client (0: without a token, 1: with the newest, others: with an old one), and if they do."""
        if pick == 0 or not self.tokens:
            return {}, self.holder is None
        return {"Lease-Token": self.tokens[-1 if pick == 1 else 0]}, (pick == 1 or len(self.tokens) == 1) and (
            self.holder is not None
        )

    def send(self, path: str, body: Any = None, headers: dict[str, str] | None = None) -> httpx2.Response:
        return self.client.post(path, json=body, headers=headers)

    def lose_all(self) -> None:
        for task_id in self.begun:
            assert self.tasks.get(task_id).wait(20.0)
            assert self.tasks.get(task_id).state != "succeeded"
        self.begun.clear()

    @rule()
    def stop(self) -> None:
        self.counts.append(self.send("/v1/stop").json()["count"])
        self.is_latched = True
        self.lose_all()

    @rule(pick=PICK, is_old=st.booleans())
    def reset(self, pick: int, is_old: bool) -> None:
        headers, may = self.headers(pick)
        old = is_old and len(self.counts) > 1
        answer = self.send("/v1/stop/reset", {"seen_count": self.counts[-2 if old else -1]}, headers)
        assert (answer.status_code == 200) == (may and not old), answer.text
        if may and not old and self.is_latched:
            self.is_latched = False
            self.counts.append(answer.json()["count"])

    @rule(name=NAMES)
    def acquire(self, name: str) -> None:
        is_free = self.holder is None and all(holder == name for holder in self.begun.values())
        answer = self.send("/v1/lease", {"holder": name})
        assert (answer.status_code == 200) == is_free, answer.text
        if is_free:
            self.holder = name
            self.tokens.append(answer.json()["token"])

    @rule(name=NAMES)
    def take_over(self, name: str) -> None:
        others = any(holder != name for holder in self.begun.values())
        before = self.holder
        answer = self.send("/v1/lease/take-over", {"holder": name, "reason": "the test"})
        self.tokens.append(answer.json()["token"])
        self.holder = name
        if before is not None or others:
            self.lose_all()

    @rule(pick=PICK, what=st.sampled_from(["release", "heartbeat"]))
    def keep_or_give_back(self, pick: int, what: str) -> None:
        headers, may = self.headers(max(1, pick))
        if headers:
            assert (self.send(f"/v1/lease/{what}", headers=headers).status_code == 200) == may
        if headers and may and what == "release":
            self.holder = None

    @precondition(lambda self: len(self.begun) < MOST)
    @rule(pick=PICK)
    def begin(self, pick: int) -> None:
        headers, may = self.headers(pick)
        answer = self.send("/v1/hold", {}, headers)
        assert (answer.status_code == 202) == (may and not self.is_latched), answer.text
        if answer.status_code == 202:
            self.begun[answer.json()["id"]] = self.holder

    @rule()
    def cancel(self) -> None:
        if self.begun:
            task_id = next(iter(self.begun))
            assert self.send(f"/v1/tasks/{task_id}/cancel?wait_s=10").json()["state"] == "cancelled"
            del self.begun[task_id]

    @invariant()
    def agrees_with_the_model(self) -> None:
        assert self.client.get("/v1/stop").json()["is_latched"] == self.is_latched
        assert self.client.get("/v1/lease").json()["holder"] == self.holder
        moving = {task.id for task in self.tasks.all() if task.moves and not task.state.is_final}
        assert moving == set(self.begun)

    def teardown(self) -> None:
        """Leave a cell in which the next example can begin."""
        token = self.send("/v1/lease/take-over", {"holder": "end", "reason": "the test ends"}).json()["token"]
        for task_id in self.begun:
            self.tasks.get(task_id).ask_cancel("the test ends")
            assert self.tasks.get(task_id).wait(20.0)
        seen = self.client.get("/v1/stop").json()
        self.send("/v1/stop/reset", {"seen_count": seen["count"]}, {"Lease-Token": token})
        self.send("/v1/lease/release", headers={"Lease-Token": token})


def test_no_order_of_requests_breaks_the_model(client: httpx2.Client, served: Panelwright) -> None:
    lease = served.service.lease
    ttl_s, lease.ttl_s = lease.ttl_s, 1e6  # lapses are the subject of tests/service/tasks/test_lease.py
    lease.subs.window_s, window_s = 1e6, lease.subs.window_s
    try:
        run_state_machine_as_test(lambda: Life(client, served), settings=LIMITS)
    finally:
        lease.ttl_s, lease.subs.window_s = ttl_s, window_s
