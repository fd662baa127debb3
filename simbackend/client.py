"""Client of the world process: starts it, keeps its newest snapshot, and lets the cell's clock advance it."""

from __future__ import annotations

import heapq
import itertools
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.clock import Clock, SimClock
from hal.config import Cell
from hal.errors import ConfigError, DeviceFault, InvalidRequest
from hal.registry import Context
from hal.simulated import Truth
from simbackend.arm_model import MODELS
from simbackend.bodies.body import is_shown
from simbackend.draws import Draws
from simbackend.events import NearTriggers, schedule
from simbackend.link import WorldLink
from simbackend.wire import (
    GRIPPER_AT,
    JOINTS_AT,
    LIGHTS_AT,
    MAX_PROXIMITY,
    REQUEST,
    DriveCommand,
    Op,
    PictureInfo,
    PictureType,
    Snapshot,
    WorldConfig,
)

PROXIMITY_RANGE_M = 0.6
MOST_TICKS_BEHIND = 100
NEAR_TICKS = 4  # how often what waits for the finger tips is checked; the world updates their place as often


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Snapshot, and when it was valid on the cell's clock."""

    snapshot: Snapshot
    host_time_s: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CameraView:
    """Pinhole picture to render; pixel (0, 0) is the centre of a pixel."""

    flange_from_camera: RigidTransform
    width: int
    height: int
    focal: tuple[float, float]
    centre: tuple[float, float]
    near_m: float


class WorldClient:
    """Client of one world process. Commands are stored and sent with the next step; only `advance` lets time pass."""

    def __init__(self, config: WorldConfig, clock: Clock) -> None:
        self.cell = config.cell
        self.draws = Draws(config.cell.file.cell.seed)
        self.rate_hz = config.cell.file.cell.control_rate_hz
        self.proximity: tuple[str, ...] = ()
        self._clock = clock
        self._lock = threading.RLock()  # guards the world: held while it steps and while it renders
        self._orders = threading.Lock()  # guards the next step's request, so that commands do not wait for a picture
        self._request = np.zeros(REQUEST)
        self._under_way = 0  # drive command of the step in progress
        self._owed_ticks = 0.0
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()  # breaks ties: of two events at one tick the first added comes first
        self._link = WorldLink(config)
        self._take(self._link.first)
        self._begun_s = clock.now_s()
        self.near = NearTriggers()
        schedule(self)
        clock.attach(self.advance)  # type: ignore[attr-defined]  # checked by `start`

    @classmethod
    def shared(cls, context: Context) -> WorldClient:
        """Return the world of a device's cell; the first device starts it."""
        return context.shared.get("world", lambda: cls.start(context))

    @classmethod
    def start(cls, context: Context) -> WorldClient:
        """Start the world of a cell.

        Raises:
            ConfigError: no cell, a clock that cannot drive a world, or an unknown arm model.
            DeviceUnavailable: the world process does not start.
        """
        cell = context.cell
        if cell is None:
            raise ConfigError("a simulated device needs a cell file", hint="load it with a cell, e.g. cells/bench.toml")
        if not hasattr(context.clock, "attach"):
            raise ConfigError(
                "a simulated device needs a clock that its world can drive",
                hint='set cell.mode = "sim" or "mixed"',
                key="cell.mode",
            )
        _check_park(cell)
        _check_shows(cell)
        names = [name for name, driver, _ in _sim_devices(cell) if driver == "sim:proximity"]
        if len(names) > MAX_PROXIMITY:
            raise ConfigError(f"a simulated cell has at most {MAX_PROXIMITY} proximity sensors", hint="remove some")
        draws = Draws(cell.file.cell.seed)
        config = WorldConfig(
            cell=cell,
            model=_arm_model(cell),
            proximity=tuple(true_mount(cell, draws, name) for name in names),
            proximity_range_m=PROXIMITY_RANGE_M,
            lookahead_s=_lookahead_s(cell),
        )
        client = cls(config, context.clock)
        client.proximity = tuple(names)
        return client

    # -- time -----------------------------------------------------------------------------------------------------

    def advance(self, duration_s: float) -> float:
        """Send pending commands, step the world and take its snapshot; return the new simulated time."""
        with self._lock:
            self._owed_ticks += duration_s * self.rate_hz + self._missed_ticks()
            ticks = max(1, int(self._owed_ticks + 0.5))
            self._owed_ticks -= ticks
            while ticks > 0:
                now = self.frame.snapshot.tick
                part = min(ticks, max(1, self._events[0][0] - now)) if self._events else ticks
                part = min(part, NEAR_TICKS) if self.near.waiting else part
                self._step(part)
                ticks -= part
                self._run_events()
            return self.frame.snapshot.stamp_s

    def _missed_ticks(self) -> float:
        """Return the ticks by which a world paced by the wall clock has fallen behind it.

        If they were dropped, a controller that follows the wall clock would run ahead of a lagging world, and the arm
        would jump. After a pause in which nobody advanced time, the world continues from where it stood.
        """
        if isinstance(self._clock, SimClock):
            return 0.0
        now_s = self._clock.now_s()
        behind = (now_s - self._begun_s) * self.rate_hz - self.frame.snapshot.tick - self._owed_ticks
        lost = max(0.0, behind - MOST_TICKS_BEHIND)
        self._begun_s += lost / self.rate_hz
        return max(0.0, behind - lost)

    def _step(self, ticks: int) -> None:
        with self._orders:
            request = self._request
            request[0], request[1] = Op.STEP, ticks
            self._under_way = int(request[2])
            message = request.tobytes()
            request[:] = 0.0
        self._take(self._link.step(message))
        self._under_way = 0

    def _take(self, message: bytes) -> None:
        snapshot = Snapshot(np.frombuffer(message))
        stamp_s = snapshot.stamp_s if isinstance(self._clock, SimClock) else self._clock.now_s()
        self.frame = Frame(snapshot, stamp_s)

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Run `action` when the world reaches a simulated time; immediately if it already has."""
        tick = round(time_s * self.rate_hz)
        with self._lock:
            if tick <= self.frame.snapshot.tick:
                action()
                return
            heapq.heappush(self._events, (tick, next(self._order), action))

    def _run_events(self) -> None:
        while self._events and self._events[0][0] <= self.frame.snapshot.tick:
            heapq.heappop(self._events)[2]()
        if self.near.waiting:
            snapshot = self.frame.snapshot
            self.near.check(snapshot.tip_m, snapshot.stamp_s)

    # -- commands, all stored until the next step ---------------------------------------------------------------------

    @property
    def is_enabled(self) -> bool:
        """Return whether the drives would follow a set-point given now."""
        for orders in (int(self._request[2]), self._under_way):
            if orders & DriveCommand.ENABLE:
                return True
            if orders & DriveCommand.STOP:
                return False
        return self.frame.snapshot.is_enabled

    def enable(self) -> None:
        """Enable the drives from the next tick on."""
        with self._orders:
            self._request[2] = (int(self._request[2]) & DriveCommand.STOP) | DriveCommand.ENABLE

    def stop(self) -> None:
        """Brake from the next tick on, whatever else was pending."""
        with self._orders:
            self._request[2] = DriveCommand.STOP

    def aim_arm(self, position_rad: Array) -> None:
        """Set the set-point of the next tick."""
        with self._orders:
            self._request[2] = int(self._request[2]) | DriveCommand.SETPOINT
            self._request[JOINTS_AT : JOINTS_AT + len(position_rad)] = position_rad

    def aim_gripper(self, width_m: float, force_n: float, speed_m_per_s: float) -> None:
        """Set the gripper's next goal."""
        with self._orders:
            self._request[GRIPPER_AT : GRIPPER_AT + 4] = (1.0, width_m, force_n, speed_m_per_s)

    def switch_lights(self, on: tuple[bool, ...]) -> None:
        """Switch the border lights from the next tick on."""
        with self._orders:
            self._request[LIGHTS_AT : LIGHTS_AT + 1 + len(on)] = (1.0, *on)

    # -- pictures and truth ---------------------------------------------------------------------------------------

    def radiance(self, view: CameraView, *, is_colour: bool) -> tuple[PictureInfo, NDArray[np.float32]]:
        """Return the radiance at an ideal pinhole at the present tick, (H, W, 1) or (H, W, 3).

        The white plate is about 0.8.
        """
        channels = 3 if is_colour else 1
        return self._picture(view, PictureType(channels), (view.height, view.width, channels))

    def depth_m(self, view: CameraView) -> tuple[PictureInfo, NDArray[np.float32]]:
        """Return the depth along the view at the present tick, (H, W), NaN where there is no surface."""
        return self._picture(view, PictureType.DEPTH, (view.height, view.width))

    def _picture(
        self, view: CameraView, kind: PictureType, shape: tuple[int, ...]
    ) -> tuple[PictureInfo, NDArray[np.float32]]:
        matrix = np.asarray(view.flange_from_camera.as_matrix())[:3]
        lens = [view.width, view.height, view.near_m, *view.focal, *view.centre]
        # Holds the lock of the steps, so that a picture belongs to one tick.
        with self._lock:
            return self._link.picture([*lens, float(kind), *matrix.ravel().tolist()], shape)

    def truth(self, initial_s: float = 0.0) -> Truth:
        """Return the true states for the judge of a finished mission; `initial` refers to the given simulated time."""
        with self._lock:
            truth = self._link.ask(Op.TRUTH, initial_s)
        if not isinstance(truth, Truth):
            raise DeviceFault(
                "the simulated world did not return the true states",
                hint="this is a defect: report it with the log",
                device="world",
            )
        return truth

    def show(self, name: str, value: float) -> None:
        """Let an instrument or lamp show another value from now on; see `hal.simulated.ShowsValues`."""
        if name not in _shown_names(self.cell):
            raise InvalidRequest(
                f"{name} cannot be made to show a value", hint=f"name one of {', '.join(_shown_names(self.cell))}"
            )
        names = [one.name for one in self.cell.panel.objects]
        self.ask(Op.SHOW, names.index(name), value)

    def ask(self, op: Op, *arguments: float) -> object:
        """Send any other request to the world, and return its answer."""
        with self._lock:
            return self._link.ask(op, *arguments)

    def why_ended(self) -> str | None:
        """Return how the world process was lost, or None; see `WorldLink.why_ended`."""
        return self._link.why_ended()

    def close(self) -> None:
        """End the world; a second call does nothing."""
        self._link.close()


def true_mount(cell: Cell, draws: Draws, device: str) -> RigidTransform:
    """Return the true pose of a device on its parent.

    Raises:
        ConfigError: no mount, or a calibration record without one.
    """
    record = cell.calibration_of(device).mount
    if record is None:
        raise ConfigError(
            f"the calibration record of {device} has no [mount]", hint="add position_m and rpy_rad", device=device
        )
    return draws.mount(device, record)


def _sim_devices(cell: Cell) -> list[tuple[str, str, dict[str, object]]]:
    """Return (device, driver, options) of all devices that use this world, directly or behind an emulator."""
    direct = [(name, device.driver, device.options) for name, device in cell.file.devices.items()]
    behind = [(name, emulator.driver, emulator.options) for name, emulator in cell.file.emulators.items()]
    return [entry for entry in direct + behind if entry[1].startswith("sim:")]


def _shown_names(cell: Cell) -> list[str]:
    """Return the objects that can be made to show a value."""
    return [one.name for one in cell.panel.objects if is_shown(one)]


def _check_shows(cell: Cell) -> None:
    """Check what instruments are to show at first."""
    known = _shown_names(cell)
    wrong = [name for name in cell.file.simulation.shows if name not in known]
    if wrong:
        raise ConfigError(
            f"{cell.path}: simulation.shows: {', '.join(wrong)} cannot be made to show a value",
            hint=f"objects that can: {', '.join(known)}",
            key="simulation.shows",
        )


def _check_park(cell: Cell) -> None:
    """Check the park position, because the arm starts there."""
    limits = MODELS[_arm_model(cell)]().capabilities
    park = cell.file.workspace.park_rad
    joints = len(limits.links)
    if len(park) == joints and all(a < q < b for a, q, b in zip(limits.lower_rad, park, limits.upper_rad, strict=True)):
        return
    raise ConfigError(
        f"the arm {limits.model!r} cannot reach workspace.park_rad = {list(park)}",
        hint=f"give {joints} joint angles within {list(limits.lower_rad)} and {list(limits.upper_rad)} rad",
        key="workspace.park_rad",
    )


def _lookahead_s(cell: Cell) -> float:
    for _, driver, options in _sim_devices(cell):
        if driver == "sim:arm":
            return float(str(options.get("lookahead_s", 0.0)))
    return 0.0


def _arm_model(cell: Cell) -> str:
    for _, driver, options in _sim_devices(cell):
        if driver == "sim:arm":
            model = str(options.get("model", "t3"))
            if model not in MODELS:
                raise ConfigError(f"no arm model called {model!r}", hint=f"models: {', '.join(MODELS)}", model=model)
            return model
    return "t3"
