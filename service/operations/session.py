"""The state that all operations share while they run: the cell, the known facts, and the motion port."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import ConfigError, DeviceFault, InvalidRequest, MotionError, NotFound, Stopped
from hal.frames import frame_tree
from hal.geometry import UncertainPose, identity
from hal.motion import NO_LIMITS, DeclaredMotion, Hold, MotionLimits, MotionOutcome, MotionReport, Mover, RobotState
from hal.panel import Panel
from service.history.observer import NoObserver, Observer
from service.processes.connection import CellConnection
from service.report.record import MissionRecord
from service.schema.requests import InspectRequest, RecogniseRequest
from service.tasks.store import TaskContext
from service.world_model import WorldModel, expected_panel

PAUSE_HOLD_S = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OperationContext:
    """The inputs of every operation; missions write their reports into `runs_dir`; `observer` keeps what is read.

    `limits` hold in each motion.
    """

    connection: CellConnection
    task: TaskContext
    runs_dir: Path
    world: WorldModel = field(default_factory=WorldModel)
    observer: Observer = field(default_factory=NoObserver)
    limits: MotionLimits = NO_LIMITS


class NotedMover:
    """A motion port that records the motions and starts none for a cancelled task."""

    def __init__(self, mover: Mover, session: Session) -> None:
        self._mover = mover
        self._session = session

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Execute the motion; see `hal.motion.Mover.execute`."""
        self._session.context.task.check_cancelled()
        report = self._mover.execute(replace(motion, limits=self._session.context.limits))
        self._session.note(report)
        return report

    def cancel(self) -> None:
        """End the running motion; see `hal.motion.Mover.cancel`."""
        self._mover.cancel()

    def tare(self) -> Array:
        """Zero the contact wrench; see `hal.motion.Mover.tare`."""
        return self._mover.tare()

    def state(self) -> RobotState:
        """Return the newest state; see `hal.motion.Mover.state`."""
        return self._mover.state()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Session:
    """One running operation.

    Attributes:
        record: the record of the mission; None outside missions.
        span: the part of the task's progress, within 0 to 1, that this operation covers.
    """

    context: OperationContext
    record: MissionRecord | None = None
    span: tuple[float, float] = (0.0, 1.0)
    observers: tuple[Callable[[MotionReport], None], ...] = field(default=())

    @property
    def connection(self) -> CellConnection:
        """The started cell."""
        return self.context.connection

    @property
    def cell(self) -> Cell:
        """The cell file with the files that it names."""
        return self.context.connection.cell

    @property
    def panel(self) -> Panel:
        """The panel file."""
        return self.context.connection.cell.panel

    @property
    def mover(self) -> NotedMover:
        """The motion port; its motions are recorded."""
        return NotedMover(self.context.connection.mover, self)

    @property
    def world(self) -> WorldModel:
        """The facts that the cell has measured so far."""
        return self.context.world

    @property
    def observer(self) -> Observer:
        """What keeps the readings."""
        return self.context.observer

    def progress(self, fraction: float, step: str, detail: str = "") -> None:
        """Report the progress of this operation, 0 to 1.

        Raises:
            Cancelled: the task was cancelled.
        """
        low, high = self.span
        self.context.task.progress(low + fraction * (high - low), step, detail)

    def part(self, low: float, high: float) -> Session:
        """Return the same session for a part of the work, given as a range of this session's progress."""
        a, b = self.span
        return Session(
            context=self.context,
            record=self.record,
            span=(a + low * (b - a), a + high * (b - a)),
            observers=self.observers,
        )

    def run(
        self, motion: DeclaredMotion, *, expect: Collection[MotionOutcome] = (MotionOutcome.COMPLETED,)
    ) -> MotionReport:
        """Execute a declared motion and record its report.

        Raises:
            Stopped, DeviceFault, MotionError: it ended with an outcome that is not in `expect`.
            Cancelled: the task was cancelled meanwhile.
        """
        report = self.mover.execute(motion)
        if report.outcome not in expect:
            raise self.failure(report)
        return report

    def note(self, report: MotionReport) -> None:
        """Record the report of a motion."""
        if self.record is not None:
            self.record.motions.append(report)
        for observe in self.observers:
            observe(report)

    def first(self, kind: DeviceKind) -> str:
        """Return the name of the first device of a kind.

        Raises:
            ConfigError: the cell file has none.
        """
        names = self.cell.names_of(kind)
        if not names:
            raise ConfigError(
                f"cell {self.cell.name!r} has no {kind}",
                hint=f"add a device of kind {kind} to {self.cell.path}",
                file=str(self.cell.path),
            )
        return names[0]

    def has_mount(self, device: str) -> bool:
        """Return whether the cell file gives a mount for this device."""
        return self.cell.file.devices[device].mount is not None and self.cell.calibration_of(device).mount is not None

    def mount(self, device: str) -> UncertainPose:
        """Return `flange_from_device` of a mounted device, with the covariance of its calibration."""
        return frame_tree(self.cell, identity()).base_from(device)

    def one_sigma_lenses(self) -> dict[str, tuple[CameraIntrinsics, ...]]:
        """Return for each camera its lens with one independent error of one sigma at a time."""
        records = {
            camera: self.cell.calibration_of(camera).intrinsics for camera in self.cell.names_of(DeviceKind.CAMERA)
        }
        return {camera: record.one_sigma_lenses() for camera, record in records.items() if record is not None}

    def lens(self, camera: str | None = None) -> CameraIntrinsics:
        """Return the intrinsics of the camera (the first one by default).

        Raises:
            ConfigError: its calibration record has none.
        """
        name = camera or self.first(DeviceKind.CAMERA)
        record = self.cell.calibration_of(name)
        if record.intrinsics is None:
            raise ConfigError(
                f"calibration of {name} has no [intrinsics]",
                hint=f"run `panelwright calibrate camera --device {name}`",
                device=name,
            )
        return record.intrinsics.intrinsics()

    def lens_rms_px(self, camera: str) -> float:
        """Return the residual of the lens calibration, px."""
        record = self.cell.calibration_of(camera).intrinsics
        return 0.0 if record is None else record.rms_px

    def known_panel(self) -> UncertainPose:
        """Return the estimated pose of the panel.

        Raises:
            NotFound: the panel has not been located yet.
        """
        pose = self.world.base_from_panel
        if pose is None:
            raise NotFound(
                "the panel has not been located yet", hint="POST /v1/panel-pose first, or send a pose with the request"
            )
        return pose

    def believed_panel(self) -> UncertainPose:
        """Return the newest estimate of the panel's pose, or the pose that the cell file expects."""
        return self.world.base_from_panel or expected_panel(self.cell)

    def begin_step(self, path: str) -> None:
        """Report that a step of a mission begins, and hold the arm before it for as long as the task is paused.

        The holds are no part of the record.

        Raises:
            Cancelled: the task was cancelled.
            Stopped, DeviceFault, MotionError: a hold ended otherwise than wanted.
        """

        def hold() -> None:
            report = self.context.connection.mover.execute(Hold(name="pause", duration_s=PAUSE_HOLD_S))
            if report.outcome is not MotionOutcome.COMPLETED:
                raise self.failure(report)

        self.progress(0.0, f"step {path}")
        self.context.task.pause_point(hold)

    def failure(self, report: MotionReport) -> Exception:
        """Return the error for a motion that ended otherwise than wanted."""
        self.context.task.check_cancelled()
        what = f"motion {report.name!r} ended as {report.outcome}: {report.cause}"
        match report.outcome:
            case MotionOutcome.STOPPED:
                return Stopped(what, hint="reset the stop (POST /v1/stop/reset), then command again")
            case MotionOutcome.FAULT if report.device is None:
                hint = "something is in the way, or the panel is not where it was: see the wrench plot of the report"
                return MotionError(what, hint=hint, motion=report.name)
            case MotionOutcome.FAULT:
                hint = "see the named device in GET /v1/devices; an arm that failed stays there until the stop is reset"
                return DeviceFault(what, hint=hint, motion=report.name, device=report.device)
            case MotionOutcome.CANCELLED:
                return MotionError(what, hint="start the task again when ready", motion=report.name)
        return MotionError(what, hint="look at the wrench plot of the report", motion=report.name)


def panel_object_or_all(panel: Panel, names: Collection[str] | None) -> tuple[str, ...]:
    """Return the named objects in the order of the panel file; all objects for None.

    Raises:
        InvalidRequest: a name is unknown; the hint gives the nearest known one.
    """
    if names is None:
        return tuple(panel_object.name for panel_object in panel.objects)
    for name in names:
        panel.object(name)
    if not names:
        raise InvalidRequest("no objects were named", hint="leave `objects` out to mean all of them")
    return tuple(panel_object.name for panel_object in panel.objects if panel_object.name in names)


def check_looked_for(cell: Cell, request: InspectRequest | RecogniseRequest) -> None:
    """Raise `InvalidRequest` for an object that the cell's panel lacks, unless the request names a stored image."""
    if request.image is None:
        for name in request.objects or ():
            cell.panel.object(name)
