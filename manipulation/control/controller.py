"""The controller: executes declared motions on the control thread, one at a time, and reports what really happened.

Every tick it reads all devices, checks the stop latch, cancellation and guards, computes the set-point, filters it,
sends it, and lets one period pass. On a simulated clock the period steps the world in lockstep, and nothing runs
between motions. On a wall clock the thread ticks all the time and holds the arm.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import ToolLoad
from hal.clock import Clock, SimClock
from hal.config import SafetySection
from hal.errors import DeviceFault, MotionRefused, Stopped
from hal.geometry import identity
from hal.motion import (
    CartesianPath,
    CellSignals,
    DeclaredMotion,
    MotionOutcome,
    MotionReport,
    RobotState,
)
from manipulation.arm import kernels as arm_kernels
from manipulation.arm.kinematics import Kinematics
from manipulation.control import braking, kernels
from manipulation.control.control_thread import JOIN_S, ControlThread
from manipulation.control.drives import Drives
from manipulation.control.executors import Executor, Tick, begin
from manipulation.control.following_error import FollowingErrorMonitor
from manipulation.control.recorder import Recorder
from manipulation.control.sensing import (
    ContactWrench,
    DeviceFailure,
    Devices,
    MotionDevices,
    Sample,
    ToolReading,
    ToolView,
    range_readers,
    refuse,
    state_of,
)
from manipulation.control.setpoint import SetPointLimiter, check, check_is_felt, flange_matrix, is_retreat
from manipulation.control.termination import (
    Termination,
    TerminationMonitor,
    cause_of_end,
    force_limit_n,
    has_settled,
    speed_limit_m_per_s,
)
from manipulation.control.way_back import LONGEST_S, WayBack
from manipulation.plausibility.hand import TouchMonitor
from manipulation.plausibility.repetition import RepeatedWrench

TARE_S = 0.1
LATE_TICKS = 2  # a longer tick delays the motion; catching up 50 ms would raise an approach of 0.06 m/s to 0.25 m/s
SLOW_TICKS = 4  # gripper and proximity sensors are read once per this many ticks


class Controller:
    """Implements `hal.motion.Mover` with the devices of one cell.

    Args:
        safety: force and speed limits that hold in every motion.
        load: mass and centre of mass of what hangs below the sensor, and the sensor's bias, which `tare` corrects.
        is_latched: reads the stop latch; called every tick.
        signals: read every tick, too.
        flange_from_grip: the tool of motions that name none.
        rate_hz: control rate; None takes the arm's.
    """

    def __init__(
        self,
        devices: MotionDevices,
        *,
        clock: Clock,
        safety: SafetySection,
        load: ToolLoad,
        flange_from_sensor: RigidTransform,
        is_latched: Callable[[], bool],
        signals: CellSignals | None = None,
        flange_from_grip: RigidTransform | None = None,
        rate_hz: float | None = None,
    ) -> None:
        self._devices = Devices(
            arm=devices.arm,
            gripper=devices.gripper,
            force_torque=devices.force_torque,
            touch=devices.touch,
            proximities=range_readers(devices.proximities, clock, max_age_s=safety.max_reading_age_s),
            clock=clock,
            max_age_s=safety.max_reading_age_s,
            repeated_wrench=RepeatedWrench(devices.force_torque),
        )
        self._touch_monitor = TouchMonitor(devices.touch, devices.force_torque)
        self._is_retreat = False  # whether the running motion goes on when a sensor fails
        capabilities = devices.arm.capabilities()
        self.kinematics = Kinematics.of(capabilities, safety.joint_limits_rad)
        self._clock = clock
        self._safety = safety
        self._contact = ContactWrench(load, flange_from_sensor)
        self._is_latched = is_latched
        self._signals = signals or CellSignals()
        self._way_back = WayBack(self._signals, clock, self._perform)
        self._grip = flange_matrix(identity() if flange_from_grip is None else flange_from_grip)
        self._dt_s = 1.0 / (rate_hz or capabilities.command_rate_hz)
        self._filter = SetPointLimiter(self.kinematics, self._grip, safety.speed_limit_m_per_s, self._dt_s)
        self._drives = Drives(devices.arm, clock, self._dt_s)
        self._standing = FollowingErrorMonitor(devices.arm.name, self.kinematics, self._grip, self._drives)
        self._is_lockstep = isinstance(clock, SimClock)
        self._thread = ControlThread(beat=None if self._is_lockstep else self._hold, at_end=self._drives.stop)
        self._busy = threading.Lock()
        self._cancel = threading.Event()
        self._newest: Sample | None = None
        self._faults: tuple[str, ...] = ()
        self._not_stopped: tuple[str, ...] = ()
        self._is_moving = False
        self._is_closing = False

    # -- life ------------------------------------------------------------------------------------------------------

    def start(self) -> None:
        """Compile or load the kernels, then start the control thread; a second call does nothing."""
        kernels.warm(self.kinematics.dh)
        braking.warm(self.kinematics.dh)
        self._thread.start()

    def close(self) -> None:
        """Cancel the running motion (not a way back), stop the arm and end the thread; a second call does nothing."""
        self._is_closing = True  # a motion that begins at this moment clears `_cancel`
        self._cancel.set()
        self._thread.close(within_s=JOIN_S + (LONGEST_S if self._signals.goes_back() else 0.0))

    def ticking(self) -> int | None:
        """Return the id of the control thread while it must have a turn in each tick; see `ControlThread.ticking`."""
        return self._thread.ticking

    def execute(self, motion: DeclaredMotion) -> MotionReport:
        """Execute the motion on the control thread and wait for its end.

        Raises:
            MotionRefused: the motion is not finite, exceeds limits or starts too far away, or another motion runs.
            Stopped: the stop latch is set.
        """
        if not self._busy.acquire(blocking=False):
            raise MotionRefused(f"motion {motion.name!r} refused: another motion runs", hint="wait for it or cancel it")
        try:
            self._cancel.clear()
            return self._thread.do(lambda: self._execute(motion))
        finally:
            self._busy.release()

    def cancel(self) -> None:
        """Let the running motion decelerate and end with outcome `cancelled`; returns at once."""
        self._cancel.set()

    def tare(self) -> Array:
        """Take the present wrench, averaged over 0.1 s at rest, as zero contact; returns the bias (6,) in sensor axes.

        Raises:
            MotionRefused: a motion runs.
            Stopped: the stop latch is set.
            DeviceFault: a device failed meanwhile; the error names it.
        """
        if not self._busy.acquire(blocking=False):
            raise MotionRefused("tare refused: a motion runs", hint="tare when the arm rests")
        try:
            return self._thread.do(self._tare)
        finally:
            self._busy.release()

    def state(self) -> RobotState:
        """Return the newest snapshot; between motions on a simulated clock the devices are read for it.

        Raises:
            DeviceFault: there is no snapshot, and a device fails.
        """
        if self._is_lockstep and self._busy.acquire(blocking=False):
            try:
                self._thread.do(self._refresh)
            finally:
                self._busy.release()
        sample = self._newest
        if sample is None:
            sample = self._thread.do(self._refresh)
        return self._state_of(sample)

    def not_stopped(self) -> tuple[str, ...]:
        """Return which devices did not do what the last stop or early end asked of them, and why; asks no device."""
        return self._not_stopped

    def _hold(self) -> None:
        """Run one tick between motions on a wall clock: hold the arm, serve its watchdog and refresh the state."""
        if self._is_latched():  # checked before reading: the drives must go off even if a device is dead
            self._stop_drives()
        with suppress(DeviceFailure):
            sample = self._read()
            if self._drives.are_on:
                self._send(self._filter.last_rad)
            self._newest = sample
        self._drives.pass_tick()

    def _refresh(self) -> Sample:
        try:
            self._newest = self._read(is_tolerant=True)
        except DeviceFailure as failure:
            if self._newest is None:
                raise DeviceFault(str(failure), hint="run `panelwright devices`", device=failure.device) from failure
        return self._newest

    # -- one motion ------------------------------------------------------------------------------------------------

    def _execute(self, motion: DeclaredMotion) -> MotionReport:
        if self._is_latched():
            raise Stopped("the stop latch is set", hint="reset the stop, then command again")
        report = self._perform(motion)
        self._way_back.note(report)
        if report.outcome is MotionOutcome.STOPPED and self._drives.are_on:
            try:
                self._way_back.go(motion.limits)
            finally:
                self._stop_drives()
        return report

    def _perform(self, motion: DeclaredMotion) -> MotionReport:
        check_is_felt(motion, has_force_torque=self._devices.force_torque is not None)
        tool = flange_matrix(motion.flange_from_tool) if isinstance(motion, CartesianPath) else self._grip
        started_s = self._clock.now_s()
        recorder = Recorder(self._dt_s)
        view = ToolView(self.kinematics.dh, self._contact, tool)
        try:
            sample = self._read(is_tolerant=is_retreat(motion))
            self._standing.check_held(sample.position_rad, self._filter)
            check(motion, self.kinematics, sample.position_rad)
            self._filter = SetPointLimiter(
                self.kinematics, tool, self._safety.speed_limit_m_per_s, self._dt_s, self._safety.workspace
            )
            self._standing.resume(sample.position_rad, self._filter)
            run = begin(motion, self.kinematics, self._devices.gripper, sample, self._clock)
        except DeviceFailure as failure:
            self._standing.give_up(failure.device)
            end = Termination(outcome=MotionOutcome.FAULT, cause=f"{failure}; nothing moved", device=failure.device)
            return self._report(motion, end, started_s, view, recorder)
        self._is_moving, self._is_retreat = True, is_retreat(motion)
        self._touch_monitor.begin(moves_pads=run.pads is not None)
        self._drives.begin_rhythm()
        try:
            end = self._run(motion, run, sample, view, recorder)
        finally:
            self._is_moving = self._is_retreat = False
        return self._report(motion, end, started_s, view, recorder)

    def _run(
        self, motion: DeclaredMotion, run: Executor, sample: Sample, view: ToolView, recorder: Recorder
    ) -> Termination:
        started_s = recorder.started_s = sample.stamp_s
        look = view.look(sample, self._filter.last_rad)
        watch = TerminationMonitor(
            motion.guards,
            force_limit_n(motion, self._safety.force_limit_n),
            look,
            arm=self._devices.arm.name,
            is_retreat=is_retreat(motion),
            is_latched=self._way_back.must_end if self._way_back.is_going else self._is_latched,
            is_cancelled=lambda: not self._way_back.is_going and (self._is_closing or self._cancel.is_set()),
        )
        ticks = 0
        late_s = 0.0
        over_since_s: float | None = None
        while True:
            elapsed_s = sample.stamp_s - started_s
            recorder.note(elapsed_s, sample.position_rad, look.wrench, look.base_from_tool[:3, 3], force_n=look.force_n)
            end = watch.ending(elapsed_s, sample, look)
            try:
                if end is None:
                    self._check_touch(sample, look)
                    tick = Tick(elapsed_s - late_s, sample, look.wrench, self._filter.last_rad, self._dt_s)
                    wanted = run.wanted(tick)
                    if run.is_over(tick):
                        over_since_s = elapsed_s if over_since_s is None else over_since_s
                        left_rad = np.abs(wanted - self._filter.last_rad)
                        if has_settled(motion, left_rad, sample.velocity_rad_per_s, elapsed_s - over_since_s):
                            if run.pads is not None:
                                run.pads.check_end(sample)
                                self._touch_monitor.pads_moved(run.pads.begun_m, sample.pads)
                            return Termination(outcome=MotionOutcome.COMPLETED, cause=cause_of_end(motion, left_rad))
                    is_reduced = self._way_back.is_going or self._signals.is_reduced()
                    self._filter.slow_to(speed_limit_m_per_s(motion, self._safety, is_reduced=is_reduced))
                    out = self._filter.apply(wanted)
                    late_s += self._dt_s * self._filter.waiting_share(wanted, out)
                    self._send(out)
                    self._drives.pass_tick()
                    ticks += 1
                    before_s = sample.stamp_s
                    sample = self._newest = self._read(None if ticks % SLOW_TICKS == 0 else sample)
                    late_s += max(0.0, sample.stamp_s - before_s - LATE_TICKS * self._dt_s)
                    look = view.look(sample, self._filter.last_rad)
                    continue
            except DeviceFailure as failure:
                end = Termination(outcome=MotionOutcome.FAULT, cause=str(failure), device=failure.device)
            self._come_to_rest(end)  # first, because a gripper that hangs must not keep the arm from its rest
            if run.pads is not None and (why := run.pads.halt(self._newest or sample, elapsed_s)) is not None:
                self._not_stopped = (*self._not_stopped, why)
            return end

    def _come_to_rest(self, end: Termination) -> None:
        """Decelerate at the limit, then hold; only the arm is used, because another device may have failed."""
        if end.device is not None:
            self._faults = (end.cause,)
        self._not_stopped = ()
        try:
            while True:
                self._send(self._filter.brake())
                self._drives.pass_tick()
                if self._filter.is_at_rest:
                    break
        except DeviceFailure as failure:
            self._not_stopped = (str(failure),)
            self._drives.switch_off()
        if end.outcome is MotionOutcome.STOPPED and not self._signals.goes_back():
            self._stop_drives()
        self._standing.give_up(end.device)
        with suppress(DeviceFailure):
            self._newest = self._read(is_tolerant=True)

    def _tare(self) -> Array:
        if self._is_latched():
            raise Stopped("the stop latch is set", hint="reset the stop, then command again")
        free: list[Array] = []
        try:
            sample = self._read()
            self._standing.check_held(sample.position_rad, self._filter)
            self._standing.resume(sample.position_rad, self._filter)
            self._drives.begin_rhythm()
            for _ in range(max(2, round(TARE_S / self._dt_s))):
                self._send(self._filter.last_rad)
                self._drives.pass_tick()
                sample = self._newest = self._read()
                flange = arm_kernels.frames(self.kinematics.dh, sample.position_rad)[-1]
                free.append(sample.raw_wrench - self._contact.weight(flange))
        except DeviceFailure as failure:
            self._standing.give_up(failure.device)
            raise DeviceFault(f"tare: {failure}", hint="run `panelwright devices`", device=failure.device) from failure
        self._contact.bias = np.mean(free, axis=0)
        return self._contact.bias.copy()

    # -- small steps -----------------------------------------------------------------------------------------------

    def _read(self, before: Sample | None = None, *, is_tolerant: bool = False) -> Sample:
        """Read the devices; in a retreat, or if tolerant, sensors may fail once there has been a sample."""
        without = self._newest if is_tolerant or self._is_retreat else None
        try:
            sample = self._devices.read(before, without=without)
        except DeviceFailure as failure:
            self._faults = self._faults or (str(failure),)  # a reader of the state sees that it is old
            raise
        self._faults = (self._faults or tuple(map(str, sample.unheard))) if sample.unheard else ()
        return sample

    def _check_touch(self, sample: Sample, look: ToolReading) -> None:
        if self._is_retreat:
            return
        tip_m = look.base_from_tool[:3, 3]
        refuse(self._touch_monitor.note(sample.contacts, look.wrench, tip_m, stamp_s=sample.stamp_s))

    def _stop_drives(self) -> None:
        """Switch the drives off, unless the stop leaves them on so that they hold the arm."""
        if not self._signals.keeps_power() and (why := self._drives.switch_off()) is not None:
            self._not_stopped = (*self._not_stopped, why)

    def _send(self, position_rad: Array) -> None:
        self._filter.sent(self._drives.send(position_rad))

    def _report(
        self, motion: DeclaredMotion, end: Termination, started_s: float, view: ToolView, recorder: Recorder
    ) -> MotionReport:
        sample = self._newest
        return recorder.report(
            motion,
            end,
            sample,
            None if sample is None else view.look(sample, self._filter.last_rad),
            span_s=(started_s, self._clock.now_s()),
            without=self._faults if is_retreat(motion) else (),
            joints=len(self.kinematics.dh),
        )

    def _state_of(self, sample: Sample) -> RobotState:
        given = {"is_moving": self._is_moving, "is_stopped": self._is_latched()}
        return state_of(sample, self._contact, self.kinematics.dh, faults=self._faults, **given)
