"""Models of the API's answers. Lengths are metres, angles radians, forces newtons, and the unit ends the name."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, Field, create_model

from hal.config import Mount
from hal.devices import DeviceKind
from hal.simulated import Fault
from hal.strict import Strict
from service.jsonable import jsonable
from service.tasks.model import Task, TaskEvent, TaskState

Finite = Annotated[float, Field(ge=-1e9, le=1e9)]


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("must have printable characters only, because it is displayed and recorded")
    return text


Holder = Annotated[str, Field(min_length=1, max_length=80, examples=["alice@console-2"]), AfterValidator(_printable)]


class ArtefactView(BaseModel):
    """A file that a task produced."""

    name: str
    media_type: str
    size_bytes: int
    url: str


class TaskView(BaseModel):
    """A task. It has a `result` when it succeeded, and a `problem` when it failed or was cancelled."""

    id: str
    verb: str
    state: TaskState
    fraction: Annotated[float, Field(ge=0, le=1)]
    step: str
    request: dict[str, Any]
    result: Annotated[Any, Field(description="result of the verb; its model is documented at the verb's POST")] = None
    problem: dict[str, Any] | None = None
    artefacts: list[ArtefactView] = []
    holder: str | None = None
    by: Annotated[str | None, Field(description="name of the key that asked for it")] = None
    sub_lease: Annotated[str | None, Field(description="its right to move: the epoch of the lease, and a number")] = (
        None
    )
    moves: bool = True
    can_pause: Annotated[bool, Field(description="whether it can stand still between its steps")] = False
    pause: Annotated[
        Literal["no", "asked", "held"],
        Field(description="held: it stands still between two steps until it is told to go on"),
    ] = "no"
    created_s: Annotated[float, Field(description="wall time, seconds since 1970")]
    started_s: float | None = None
    ended_s: float | None = None
    events_url: str

    @classmethod
    def of(cls, task: Task) -> TaskView:
        """Return the view of a task. Result and problem are shown when the task has ended and its end is on disk."""
        state = task.state
        return cls(
            id=task.id,
            verb=task.verb,
            state=state,
            fraction=task.fraction,
            step=task.step,
            request=task.request,
            result=task.result if state.is_final else None,
            problem={**task.problem} if state.is_final and task.problem else None,
            artefacts=[
                ArtefactView(
                    name=item.name,
                    media_type=item.media_type,
                    size_bytes=item.size_bytes,
                    url=f"/v1/tasks/{task.id}/artefacts/{item.name}",
                )
                for item in task.artefacts
            ],
            holder=task.holder,
            by=task.by,
            sub_lease=task.sub_lease.name if task.sub_lease is not None else None,
            moves=task.moves,
            can_pause=task.can_pause,
            pause="no" if state.is_final else task.pause,
            created_s=task.created_s,
            started_s=task.started_s,
            ended_s=task.ended_s,
            events_url=f"/v1/tasks/{task.id}/events",
        )


def task_view(result: type[BaseModel]) -> type[TaskView]:
    """Return the view of a task with a `result` of this model, such as `PanelPoseTask` for `PanelPoseResult`."""
    name = f"{result.__name__.removesuffix('Result')}Task"
    annotation: Any = result | None
    return create_model(name, __base__=TaskView, __doc__=TaskView.__doc__, result=(annotation, None))


class TaskList(BaseModel):
    """Kept tasks, newest first."""

    tasks: list[TaskView]


def event_data(event: TaskEvent) -> dict[str, Any]:
    """Return an event as plain JSON values."""
    data: dict[str, Any] = jsonable(event)
    return data


class HealthView(BaseModel):
    """The state of a device's connection and its counters."""

    connected: bool
    quality: str
    cause: str
    detail: str
    samples: int = 0
    errors: int = 0
    reconnects: int = 0
    last_sample_s: float | None = None


class DeviceView(BaseModel):
    """A device of the cell file and its health."""

    name: str
    kind: DeviceKind
    driver: str
    health: HealthView
    reading_url: str


class DeviceList(BaseModel):
    """All devices, in the order of the cell file."""

    devices: list[DeviceView]


class DeviceDetail(DeviceView):
    """A device with its capabilities, mount and options."""

    capabilities: dict[str, Any] | None = None
    mount: dict[str, Any] | None = None
    options: dict[str, Any] = {}


class ReadingView(BaseModel):
    """A reading with its time stamps; check `quality` and `age_s`, because the call also succeeds for a bad reading."""

    device: str
    kind: DeviceKind
    value: Any
    host_time_s: Annotated[float, Field(description="time of the reading on the cell's clock")]
    device_time_s: float | None
    age_s: float | None
    sequence: int
    quality: str
    cause: str
    detail: str = ""


class FaultRequest(Strict):
    """Inject a fault into a simulated device; null ends it."""

    fault: Fault | None = None
    magnitude: Finite = 0.0


class SwapRequest(Strict):
    """Another driver or other options for a device, as in its table of a cell file; kind and mount cannot change."""

    driver: Annotated[str, Field(pattern=r"^[a-z0-9_.+-]+:[a-z0-9_.+-]+$", max_length=100, examples=["serial:tfmini"])]
    options: Annotated[dict[str, Any], Field(max_length=100)] = {}
    kind: DeviceKind | None = None
    mount: Mount | None = None


class FrameView(BaseModel):
    """The pose of `child` in `parent`; covariance over (dx, dy, dz, rx, ry, rz), m and rad, in the parent's axes."""

    parent: str
    child: str
    translation_m: list[float]
    quaternion_xyzw: list[float]
    covariance: list[list[float]] | None = None
    source: Literal["calibration", "measured", "estimated"]


class FrameList(BaseModel):
    """All known poses in the cell."""

    frames: list[FrameView]


class LeaseRequest(Strict):
    """The name of the client that wants the lease."""

    holder: Holder


class TakeOverRequest(LeaseRequest):
    """The name of the client that takes the lease from its holder, and why; both are recorded."""

    reason: Annotated[
        str, Field(min_length=1, max_length=200, examples=["bob has gone home"]), AfterValidator(_printable)
    ]


class LeaseView(BaseModel):
    """The state of the lease. While `is_held` is false, everybody may move the arm."""

    is_held: bool
    holder: str | None
    epoch: int
    ttl_s: float
    remaining_s: float
    sequence: Annotated[int | None, Field(description="newest number of a command under this lease; null without one")]
    clock_s: Annotated[float, Field(description="the service's monotonic clock, for Command-Until")]


class GrantView(LeaseView):
    """A granted lease. Send `token` as `Lease-Token`, and renew the lease within `ttl_s`."""

    token: str


class StopView(BaseModel):
    """The state of the software stop, which is not a safety function: a hardware stop is required."""

    is_latched: bool
    count: Annotated[int, Field(description="increases with each change")]
    changed_time_s: float
    source: str
    level: Annotated[
        str,
        Field(
            description="off: the drives are switched off when the arm is at rest; hold: they stay on and hold it; retreat: the "
            "service was lost and the arm may be on its way back, after which they are switched off"
        ),
    ]
    not_stopped: Annotated[
        list[str], Field(description="devices that did not obey the newest stop of a motion, each with the cause")
    ]
    stop_url: Annotated[str, Field(description="address of the stop process, which stops fastest")]


class SpeedView(BaseModel):
    """The speed limit of the tool's tip that holds now."""

    is_reduced: Annotated[bool, Field(description="whether the reduced speed holds, because people are near")]
    limit_m_per_s: float


class ResetRequest(Strict):
    """Clear the stop that the caller has seen; it is refused if the stop has changed since."""

    seen_count: (
        Annotated[
            int,
            Field(
                ge=0,
                lt=2**63,
                description="`count` of the stop that the caller has seen; without it, a stop of the last second stays latched",
            ),
        ]
        | None
    ) = None


class MissionView(BaseModel):
    """The files of a finished mission. `started` is when it began (UTC, ISO 8601), from its report.

    `objects` are those that it read or operated. `unfinished_step` is where `resume` takes it up; null if nothing is left.
    """

    name: str
    started: str | None
    title: str = ""
    succeeded: bool | None = None
    objects: list[str] = []
    unfinished_step: str | None = None
    report_url: str | None
    json_url: str | None
    files: list[str]


class MissionList(BaseModel):
    """Missions with reports, newest first."""

    missions: list[MissionView]


class ProcessView(BaseModel):
    """A supervised process."""

    name: str
    pid: int | None
    is_alive: bool
    restarts: int
    detail: str


class MissingView(BaseModel):
    """A device that did not connect; the cell works without it, and the verbs in `lost` may fail."""

    device: str
    why: str
    hint: str
    lost: list[str]


class ReadyView(BaseModel):
    """Whether the cell is ready for everything, and otherwise for what.

    `is_ready` is true when the cell runs, no device is missing and the journal can record. `is_running` is true when the cell
    and the stop process run, even if devices are missing; it decides the status, 200 or 503. `lacking` has for each verb the
    missing devices that it may need: a verb with none is ready, and one with some may fail, depending on the request.
    `journal_problem` says why nothing can be recorded, so that nothing may move.
    """

    is_ready: bool
    is_running: bool
    missing: list[MissingView]
    lacking: dict[str, list[str]]
    journal_problem: str | None
    processes: list[ProcessView]


class HealthzView(BaseModel):
    """The service answers."""

    status: Literal["up"] = "up"


class InfoView(BaseModel):
    """Name, version and cell of the service."""

    name: str
    version: str
    cell: str
    mode: str
    panel: str
    seed: int
    verbs: list[str]
    stop_url: str
    console_url: Annotated[str | None, Field(description="address of the console; null if it was left out")] = None
    uptime_s: float
    event_loop_lag_p99_s: float
    safety_note: str
    access: Annotated[
        Literal["open", "keys"],
        Field(description="open: there are no keys, so every program of this machine may move it"),
    ]
