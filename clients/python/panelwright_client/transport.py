"""Carries the calls: key, lease, errors, and tasks that are waited for. Written by hand."""

from __future__ import annotations

import json
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self, TypeVar, cast

import httpx2
from pydantic import BaseModel, TypeAdapter

from panelwright_client.models import GrantView, LeaseView, Problem, TaskView

T = TypeVar("T")
FINAL = ("succeeded", "failed", "cancelled")
WAIT_S = 30.0
HEARTBEATS_A_LEASE = 4.0


class Refused(Exception):
    """The service refused a call; `problem` says why, what helps, and whether to send it again."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(f"{problem.detail}; {problem.hint}")
        self.problem = problem


class Transport:
    """A connection to one service.

    Args:
        url: its address.
        key: a key of the service, where it has keys.
        timeout_s: the longest wait for one answer.
        verify: for https, whether to check the certificate, or with what.

    Attributes:
        headers: go with every call; a lease that `lease` holds is one of them.
    """

    def __init__(
        self,
        url: str = "http://127.0.0.1:8460",
        *,
        key: str | None = None,
        timeout_s: float = 40.0,
        verify: ssl.SSLContext | bool = True,
    ) -> None:
        self.headers: dict[str, str] = {} if key is None else {"Authorization": f"Bearer {key}"}
        self._http = httpx2.Client(base_url=url, timeout=timeout_s, verify=verify, trust_env=False)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    @contextmanager
    def lease(self, holder: str) -> Iterator[GrantView]:
        """Hold the lease, the right to move, until the block ends; it is kept by heartbeats and then given back."""
        grant = self._call("POST", "/v1/lease", GrantView, body={"holder": holder})
        self.headers["Lease-Token"] = grant.token
        ended = threading.Event()

        def keep() -> None:
            while not ended.wait(grant.ttl_s / HEARTBEATS_A_LEASE):
                try:
                    self._call("POST", "/v1/lease/heartbeat", GrantView)
                except (Refused, httpx2.RequestError):
                    return  # the lease is lost; the next command is told so

        keeper = threading.Thread(target=keep, daemon=True)
        keeper.start()
        try:
            yield grant
        finally:
            ended.set()
            keeper.join()
            self._call("POST", "/v1/lease/release", LeaseView)
            del self.headers["Lease-Token"]

    def ended(self, task_id: str) -> TaskView:
        """Wait for the end of a task, and return it."""
        while True:
            task = self._call("GET", f"/v1/tasks/{task_id}", TaskView, query={"wait_s": WAIT_S})
            if task.state in FINAL:
                return task

    def events(self, task_id: str, *, after: int = 0) -> Iterator[dict[str, Any]]:
        """Yield the events of a task with a higher number than `after`, as they come, until it ends."""
        headers = {**self.headers, "Last-Event-ID": str(after), "Accept": "text/event-stream"}
        with self._http.stream("GET", f"/v1/tasks/{task_id}/events", headers=headers, timeout=None) as answer:
            if answer.is_error:
                answer.read()
                raise Refused(_problem(answer))
            for event in httpx2.EventSource(answer):
                yield json.loads(event.data)

    def _call(
        self,
        method: str,
        path: str,
        result: type[T],
        *,
        body: BaseModel | dict[str, Any] | None = None,
        data: bytes | None = None,
        query: dict[str, Any] | None = None,
        headers: dict[str, str | None] | None = None,
    ) -> T:
        """Return the answer of a call as `result`; raises `Refused` for a problem."""
        sent = body.model_dump(mode="json", exclude_unset=True, by_alias=True) if isinstance(body, BaseModel) else body
        answer = self._http.request(
            method,
            path,
            json=sent,
            content=data,
            params={key: value for key, value in (query or {}).items() if value is not None},
            headers=self.headers | {key: value for key, value in (headers or {}).items() if value is not None},
        )
        if answer.is_error:
            raise Refused(_problem(answer))
        if result is bytes or not answer.content:
            return cast(T, answer.content)
        return TypeAdapter(result).validate_json(answer.content)


def _problem(answer: httpx2.Response) -> Problem:
    try:
        return Problem.model_validate_json(answer.content)
    except ValueError:  # an answer of a proxy
        detail = f"the service answered {answer.status_code}"
        return Problem.model_validate(
            {"type": "about:blank", "title": "Problem", "status": answer.status_code, "detail": detail}
            | {"hint": "see the log of the service", "retry": "never"}
        )
