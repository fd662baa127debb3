"""Arm of a ROS 2 system: joint states in, set-points out to a controller of ros2_control, over rosbridge.

ROS has no watchdog for set-points. Each set-point is a trajectory of one point, `horizon_s` ahead, which the
joint_trajectory_controller runs to its end and then holds. So an arm whose host falls silent stops within `horizon_s`, at the
last set-point. A forward_command_controller goes to each set-point at once, and holds it.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.kinds.arms import KinematicsOptions, SetPointFilter, capabilities
from drivers.kinds.digital_points import require_same_number
from drivers.ros2.messages import JOINT_STATE, JOINT_TRAJECTORY, POSITIONS, duration, joints_of, positions, trajectory
from drivers.ros2.rosbridge import MessageTimes, Ros2Options, RosbridgeDevice, Topic
from drivers.transport.link import Link, now_s
from drivers.transport.options import read_options
from hal.arrays import Array
from hal.clock import Deadline, WallClock
from hal.devices import ArmCapabilities, DeviceKind, JointState
from hal.errors import CellError, MotionRefused
from hal.readings import Stamped
from hal.registry import Context, takes

MOVING_RAD_PER_S = 1e-3
STRICT = 2  # SwitchController: refuse unless all controllers switch
CLOSE_S = 0.05
DIFFERENCE_S = 0.2  # velocities are differences of positions no further apart than this


class Ros2ArmOptions(Ros2Options):
    """Options of `ros2:arm`."""

    joints: Annotated[tuple[str, ...], Field(min_length=1)] = Field(
        description="names of the joints in ROS, from the base to the flange, one for each link of `kinematics`",
        examples=[["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]],
    )
    kinematics: KinematicsOptions = Field(description="links and limits of the arm, from its data sheet")
    joint_states: Topic = Field(default="/joint_states", description="topic of the joint_state_broadcaster")
    command: Literal["trajectory", "positions"] = Field(
        default="trajectory",
        description="`trajectory` for a joint_trajectory_controller, `positions` for a forward_command_controller",
    )
    command_topic: Topic = Field(
        default="/joint_trajectory_controller/joint_trajectory",
        description="topic of the controller: `NAME/joint_trajectory`, or `NAME/commands` with positions",
    )
    rate_hz: Annotated[float, Field(gt=0, le=500)] = Field(default=100.0, description="set-points per second")
    horizon_s: Annotated[float, Field(ge=0.01, le=1)] = Field(
        default=0.05,
        description="time until a set-point is reached, and in which an arm without further set-points comes to rest; two to "
        "five periods of `rate_hz`; it delays the motion by about as much",
    )
    controller: str | None = Field(
        default=None,
        description="name of the controller that enabling activates; without it, it must be active already",
    )
    deactivate: tuple[str, ...] = Field(
        default=(), description="controllers that enabling deactivates, because they claim the same joints"
    )
    controller_manager: Topic = Field(default="/controller_manager", description="node of the controller manager")

    def commanded(self) -> tuple[str, ...]:
        """Return the topic of the set-points."""
        return (self.command_topic,)

    def known_arm(self) -> ArmCapabilities:
        """Return the kinematics and limits given by `kinematics`."""
        return capabilities(self.kinematics, command_rate_hz=self.rate_hz, watchdog_s=self.horizon_s)

    @model_validator(mode="after")
    def _one_name_a_joint(self) -> Self:
        require_same_number("joints and the links of kinematics", self.joints, self.kinematics.links)
        if len(set(self.joints)) != len(self.joints):
            raise ValueError("joints must all have different names")
        return self


class Ros2Arm(RosbridgeDevice[JointState]):
    """Arm behind rosbridge."""

    kind = DeviceKind.ARM

    def __init__(self, context: Context, options: Ros2ArmOptions) -> None:
        type_ = JOINT_TRAJECTORY if options.command == "trajectory" else POSITIONS
        topics, outputs = {options.joint_states: JOINT_STATE}, {options.command_topic: type_}
        super().__init__(context, options, topics=topics, outputs=outputs)
        self._options = options
        self._filter = SetPointFilter(context.name, options.kinematics, command_rate_hz=options.rate_hz)
        self._times = MessageTimes(1.0 / options.rate_hz)
        self._before: tuple[float, Array] | None = None  # time and positions of the message before
        self._sent: Array | None = None
        self._commands = threading.Lock()

    def capabilities(self) -> ArmCapabilities:
        """Return the capabilities given by the options."""
        return self._options.known_arm()

    def read_state(self, *, deadline: Deadline) -> Stamped[JointState]:
        """Return the newest measured joint state."""
        return self.newest(deadline)

    def enable(self, *, deadline: Deadline) -> None:
        """Activate the controller, if one is named, and hold the measured position.

        Raises:
            MotionRefused: a stop came meanwhile, or the controller manager does not switch.
            DeviceTimeout: the controller manager does not answer.
        """
        closings = self._filter.closings
        self.newest(deadline)
        if self._options.controller is not None:
            self._switch_controllers(self._options.controller, deadline)
        measured = self.newest(deadline).value.position_rad
        with self._commands:
            self._filter.check_not_closed_since(closings)
            self._go(measured, self._options.horizon_s, deadline)
            self._filter.begin(measured, closings=closings)

    def _switch_controllers(self, controller: str, deadline: Deadline) -> None:
        o = self._options
        args = {
            "activate_controllers": [controller],
            "deactivate_controllers": list(o.deactivate),
            "strictness": STRICT,
            "activate_asap": True,
            "timeout": duration(deadline.remaining_s()),
        }
        if self.call_service(f"{o.controller_manager}/switch_controller", args, deadline).get("ok") is not True:
            raise MotionRefused(
                f"{self.name}: the controller manager does not activate {controller}",
                hint=f"look at `ros2 control list_controllers -c {o.controller_manager}`, and at the robot's own state",
                device=self.name,
            )

    def command_position(self, position_rad: Array, *, deadline: Deadline) -> Array:
        """Publish one set-point."""
        self.require_open()
        with self._commands:
            sent = self._filter.passed(position_rad, now_s())
            self._go(sent, self._options.horizon_s, deadline)
            return sent

    def stop(self, *, deadline: Deadline) -> None:
        """Replace the set-point by the place where the arm comes to rest when it decelerates at its limits."""
        self.require_open()
        was_open = self._filter.is_open
        self._filter.close()
        if was_open:
            self._brake(deadline)

    def _brake(self, deadline: Deadline) -> None:
        k = self._options.kinematics
        newest = self.mailbox.peek()
        with self._commands:
            if newest is None or newest.age_s(self.context.clock.now_s()) > self.max_age_s:
                if self._sent is not None:  # a moving arm that is not seen runs on to its last set-point at most
                    self._go(self._sent, self._options.horizon_s, deadline)
                return
            velocity, limit = newest.value.velocity_rad_per_s, np.array(k.acceleration_rad_per_s2)
            rest = newest.value.position_rad + velocity * np.abs(velocity) / (2.0 * limit)
            after_s = max(self._options.horizon_s, float(np.max(np.abs(velocity) / limit)))
            self._go(np.clip(rest, k.lower_rad, k.upper_rad), after_s, deadline, is_last=True)

    def _go(self, position_rad: Array, after_s: float, deadline: Deadline, *, is_last: bool = False) -> None:
        o = self._options
        self._sent = position_rad
        if o.command == "positions":
            self.send(o.command_topic, positions(position_rad), deadline)
            return
        velocity = np.zeros_like(position_rad) if is_last else None
        message = trajectory(o.joints, position_rad, after_s, velocity_rad_per_s=velocity)
        self.send(o.command_topic, message, deadline)

    def start(self, link: Link) -> None:
        """Subscribe and advertise; motion stays disabled."""
        self._filter.close()
        self._times.reset()
        self._before = None
        super().start(link)

    def take(self, topic: str, message: dict[str, Any], raw: bytes, arrived_s: float) -> None:  # noqa: ARG002  # one topic
        """Publish a joint state of this arm's joints."""
        joints = joints_of(message, self._options.joints)
        times = None if joints is None else self._times.of(joints.stamp_s, raw, arrived_s)
        if joints is None or times is None:
            return
        valid_s, device_s = times
        velocity = self._velocity(joints.position, joints.velocity, valid_s if device_s is None else device_s)
        self.publish(
            JointState(
                position_rad=joints.position,
                velocity_rad_per_s=velocity,
                is_enabled=self._filter.is_open,
                is_moving=bool(np.any(np.abs(velocity) > MOVING_RAD_PER_S)),
            ),
            valid_s=valid_s,
            device_time_s=device_s,
        )

    def _velocity(self, position_rad: Array, given: Array, at_s: float) -> Array:
        """Return the velocities of the message or, where it has none, the differences from the message before."""
        before, self._before = self._before, (at_s, position_rad)
        if np.all(np.isfinite(given)):
            return given
        if before is None or not 0.0 < at_s - before[0] < DIFFERENCE_S:
            return np.zeros_like(position_rad)
        difference: Array = (position_rad - before[1]) / (at_s - before[0])
        return difference

    def lost(self, error: Exception) -> None:
        """Refuse further set-points and report the loss; the arm stops at the last one."""
        self._filter.close()
        super().lost(error)

    def release(self) -> None:
        """Stop the arm if it was enabled, then disconnect."""
        if self._filter.is_open:
            self._filter.close()
            with suppress(CellError):
                self._brake(Deadline.after(WallClock(), CLOSE_S))
        super().release()


@takes(Ros2ArmOptions)
def connect(context: Context, options: dict[str, Any]) -> Ros2Arm:
    """Entry point `ros2:arm`."""
    device = Ros2Arm(context, read_options(context, options, Ros2ArmOptions))
    device.join()
    return device
