"""The table of permissions: which role each call needs, and whether it asks the lease. A test compares it with the routes.

A call without a row needs a maintainer, so that a forgotten row closes a call instead of opening it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from service.access.keys import Role


class Asks(StrEnum):
    """What a call asks apart from the key."""

    NOTHING = "nothing"  # it changes nothing, or ends something, which is always allowed
    LEASE = "lease"  # refused while another client holds the lease
    ITS_TASK = "its task"  # the lease, unless the body asks for work that neither moves nor stores anything
    ITSELF = "itself"  # the calls by which a client gets and keeps the lease


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """What one call needs. `role` None: everybody, also without a key. `is_free_here`: no key needed on this machine."""

    role: Role | None
    asks: Asks = Asks.NOTHING
    is_free_here: bool = False


EVERYBODY = Row(role=None)
OBSERVER = Row(role=Role.OBSERVER)
OPERATOR = Row(role=Role.OPERATOR)
MAINTAINER = Row(role=Role.MAINTAINER)
OPERATOR_WRITES = Row(role=Role.OPERATOR, asks=Asks.LEASE)
MAINTAINER_WRITES = Row(role=Role.MAINTAINER, asks=Asks.LEASE)
OPERATOR_TASK = Row(role=Role.OPERATOR, asks=Asks.ITS_TASK)
MAINTAINER_TASK = Row(role=Role.MAINTAINER, asks=Asks.ITS_TASK)
LEASING = Row(role=Role.OPERATOR, asks=Asks.ITSELF)
UNLISTED = Row(role=Role.MAINTAINER, asks=Asks.ITS_TASK)

TABLE: dict[str, Row] = {
    "GET /healthz": EVERYBODY,
    "GET /docs": EVERYBODY,  # the page; the document that it shows needs a key
    "GET /v1/session": EVERYBODY,
    "POST /v1/session": EVERYBODY,
    "DELETE /v1/session": EVERYBODY,
    "POST /v1/stop": Row(role=Role.OBSERVER, is_free_here=True),
    "GET /readyz": OBSERVER,
    "GET /openapi.json": OBSERVER,
    "GET /metrics": OBSERVER,
    "GET /v1/info": OBSERVER,
    "GET /v1/stop": OBSERVER,
    "GET /v1/speed": OBSERVER,
    "POST /v1/speed/reduce": Row(role=Role.OBSERVER, is_free_here=True),
    "GET /v1/lease": OBSERVER,
    "GET /v1/tasks": OBSERVER,
    "GET /v1/tasks/{task_id}": OBSERVER,
    "GET /v1/tasks/{task_id}/events": OBSERVER,
    "GET /v1/tasks/{task_id}/artefacts/{name}": OBSERVER,
    "POST /v1/tasks/{task_id}/cancel": OBSERVER,
    "GET /v1/devices": OBSERVER,
    "GET /v1/devices/{name}": OBSERVER,
    "GET /v1/devices/{name}/reading": OBSERVER,
    "GET /v1/frames": OBSERVER,
    "GET /v1/panel": OBSERVER,
    "GET /v1/mission-files": OBSERVER,
    "GET /v1/mission-files/{mission}": OBSERVER,
    "POST /v1/mission-files/check": OBSERVER,  # nothing is stored
    "PUT /v1/mission-files/{mission}": MAINTAINER,
    "GET /v1/missions": OBSERVER,
    "GET /v1/missions/{mission}/{name}": OBSERVER,
    "GET /v1/history": OBSERVER,
    "GET /v1/history/export": OBSERVER,
    "GET /v1/history/{object}": OBSERVER,
    "GET /v1/history/{object}/crops/{crop}": OBSERVER,
    "GET /v1/alarms": OBSERVER,
    "GET /v1/limits": OBSERVER,
    "GET /v1/feed": OBSERVER,
    "GET /v1/feed/events": OBSERVER,
    "GET /v1/review": OBSERVER,
    "GET /v1/rounds": OBSERVER,
    "GET /v1/rounds/{round}/runs": OBSERVER,
    "GET /v1/images": OBSERVER,
    "GET /v1/images/{image_id}": OBSERVER,
    "GET /v1/calibrations": OBSERVER,
    "GET /v1/calibrations/{name}": OBSERVER,
    "GET /v1/knowledge": OBSERVER,
    "GET /v1/knowledge/questions": OBSERVER,
    "GET /v1/knowledge/kinds/{name}": OBSERVER,
    "GET /v1/knowledge/panels/{name}": OBSERVER,
    "WS /v1/stream": OBSERVER,
    "POST /v1/lease": LEASING,
    "POST /v1/lease/heartbeat": LEASING,
    "POST /v1/lease/release": LEASING,
    "POST /v1/lease/take-over": LEASING,
    "POST /v1/stop/reset": OPERATOR_WRITES,
    "POST /v1/speed/restore": OPERATOR_WRITES,
    "POST /v1/tasks/{task_id}/pause": OPERATOR_WRITES,
    "POST /v1/tasks/{task_id}/go-on": OPERATOR_WRITES,
    "POST /v1/devices/{name}/connect": OPERATOR_WRITES,
    "POST /v1/images": OPERATOR_WRITES,
    "DELETE /v1/images/{image_id}": OPERATOR_WRITES,
    "POST /v1/alarms/{alarm}/acknowledge": OPERATOR,  # alarms are for those who watch, whoever moves the arm
    "POST /v1/alarms/{alarm}/comment": OPERATOR,
    "POST /v1/alarms/{alarm}/shelve": OPERATOR,
    "POST /v1/alarms/{alarm}/unshelve": OPERATOR,
    "POST /v1/alarms/{alarm}/out-of-service": MAINTAINER,
    "POST /v1/alarms/{alarm}/in-service": MAINTAINER,
    "PUT /v1/limits/{object}": MAINTAINER,
    "DELETE /v1/limits/{object}": MAINTAINER,
    "POST /v1/review/{reading}": OPERATOR,
    "PUT /v1/rounds/{round}": MAINTAINER,  # about later; a round that is due waits while somebody holds the lease
    "DELETE /v1/rounds/{round}": MAINTAINER,
    "POST /v1/knowledge/outline": OPERATOR,
    "POST /v1/read": OPERATOR,
    "POST /v1/read-photograph": OPERATOR,
    "POST /v1/panel-pose": OPERATOR_TASK,
    "POST /v1/recognise": OPERATOR_TASK,
    "POST /v1/inspect": OPERATOR_TASK,
    "POST /v1/fuse": OPERATOR_TASK,
    "POST /v1/manipulate": OPERATOR_TASK,
    "POST /v1/missions": OPERATOR_TASK,
    "POST /v1/judge": OPERATOR_TASK,
    "PUT /v1/devices/{name}": MAINTAINER_WRITES,
    "POST /v1/devices/{name}/fault": MAINTAINER_WRITES,
    "POST /v1/knowledge/teach": MAINTAINER_WRITES,
    "POST /v1/review/{reading}/teach": MAINTAINER_WRITES,
    "DELETE /v1/knowledge/{group}/{name}": MAINTAINER_WRITES,
    "DELETE /v1/calibrations/{name}": MAINTAINER_WRITES,
    "POST /v1/learn": MAINTAINER_TASK,
    "POST /v1/calibrations": MAINTAINER_TASK,
}


def row_of(method: str, path: str) -> Row:
    """Return what a call needs; `path` is that of its route, with parameters in braces, `method` is WS for a WebSocket."""
    return TABLE.get(f"{'GET' if method == 'HEAD' else method} {path}", UNLISTED)
