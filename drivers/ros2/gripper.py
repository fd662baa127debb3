"""Gripper of a ROS 2 system: the action GripperCommand, and its joint in the joint states, over rosbridge.

The action is what most ROS 2 drivers of grippers offer, by the gripper_action_controller or by themselves.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from drivers.kinds.grippers import require_finite
from drivers.ros2.messages import GRIPPER_COMMAND, JOINT_STATE, joints_of
from drivers.ros2.rosbridge import MessageTimes, Ros2Options, RosbridgeDevice, Topic
from drivers.transport.link import Link
from drivers.transport.options import read_options
from hal.clock import Deadline
from hal.devices import DeviceKind, GripperCapabilities, GripperState
from hal.readings import Stamped
from hal.registry import Context, takes

MOVING_PART_PER_S = 0.01  # of the stroke


class Ros2GripperOptions(Ros2Options):
    """Options of `ros2:gripper`."""

    joint: str = Field(description="name of the gripper's joint in the joint states")
    joint_states: Topic = Field(default="/joint_states", description="topic with the gripper's joint")
    action: Topic = Field(
        default="/gripper_controller/gripper_cmd", description="name of the action control_msgs/GripperCommand"
    )
    open_position: float = Field(default=0.0, description="joint position when open, in the joint's own unit")
    closed_position: float = Field(default=0.8, description="joint position when closed; 0.8 rad for a 2F-85")
    stroke_m: Annotated[float, Field(gt=0, le=0.3)] = Field(
        default=0.085, description="width between the pads when open"
    )
    max_force_n: Annotated[float, Field(gt=0)] = Field(default=60.0, description="greatest grip force")
    effort_per_n: Annotated[float, Field(gt=0)] = Field(
        default=1.0, description="`max_effort` of the action for each newton; its unit is the driver's"
    )
    max_speed_m_per_s: Annotated[float, Field(gt=0)] = Field(
        default=0.15, description="speed of the jaws, which the action does not choose"
    )
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = Field(default=50.0, description="rate of the joint states")

    def commanded(self) -> tuple[str, ...]:
        """Return the action."""
        return (self.action,)

    @model_validator(mode="after")
    def _has_a_stroke(self) -> Self:
        if self.open_position == self.closed_position:
            raise ValueError("open_position and closed_position are the ends of the stroke and must differ")
        return self


class Ros2Gripper(RosbridgeDevice[GripperState]):
    """Gripper behind rosbridge."""

    kind = DeviceKind.GRIPPER

    def __init__(self, context: Context, options: Ros2GripperOptions) -> None:
        super().__init__(context, options, topics={options.joint_states: JOINT_STATE})
        self._options = options
        self._times = MessageTimes(1.0 / options.rate_hz)
        self._goal: tuple[str, float] | None = None  # id of the last goal, and its force
        self._before: tuple[float, float] | None = None  # time and width of the message before

    def capabilities(self) -> GripperCapabilities:
        """Return the capabilities given by the options."""
        o = self._options
        return GripperCapabilities(
            min_width_m=0.0, max_width_m=o.stroke_m, max_force_n=o.max_force_n, max_speed_m_per_s=o.max_speed_m_per_s
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return the newest width; the grip is as the last goal's result says."""
        return self.newest(deadline)

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Send a goal without waiting for its result; the action takes no speed.

        Raises:
            InvalidRequest: a value is not finite. DeviceFault: rosbridge has refused an earlier message.
        """
        self.require_open()
        require_finite(self.name, width_m, force_n, speed_m_per_s)
        self.require_accepted()
        o = self._options
        width_m = min(max(width_m, 0.0), o.stroke_m)
        force_n = min(max(force_n, 0.0), o.max_force_n)
        position = o.closed_position + width_m / o.stroke_m * (o.open_position - o.closed_position)
        command = {"position": position, "max_effort": force_n * o.effort_per_n}
        goal = {"op": "send_action_goal", "action": o.action, "action_type": GRIPPER_COMMAND, "feedback": False}
        id_ = self.begin({**goal, "args": {"command": command}}, deadline)
        old, self._goal = self._goal, (id_, force_n)
        if old is not None:
            self.forget(old[0])
        return width_m

    def start(self, link: Link) -> None:
        """Subscribe."""
        self._times.reset()
        self._before = None
        super().start(link)

    def take(self, topic: str, message: dict[str, Any], raw: bytes, arrived_s: float) -> None:  # noqa: ARG002  # one topic
        """Publish the gripper's joint as width."""
        o = self._options
        joints = joints_of(message, (o.joint,))
        times = None if joints is None else self._times.of(joints.stamp_s, raw, arrived_s)
        if joints is None or times is None:
            return
        valid_s, device_s = times
        part = (float(joints.position[0]) - o.closed_position) / (o.open_position - o.closed_position)
        width_m = min(max(part, 0.0), 1.0) * o.stroke_m
        at_s = valid_s if device_s is None else device_s
        speed_m_per_s = self._speed(width_m, float(joints.velocity[0]), at_s)
        is_moving = abs(speed_m_per_s) > MOVING_PART_PER_S * o.stroke_m
        held_n = self._held_n()
        is_holding = held_n is not None and not is_moving
        self.publish(
            GripperState(
                width_m=width_m,
                force_n=held_n if is_holding and held_n is not None else 0.0,
                is_moving=is_moving,
                is_holding=is_holding,
            ),
            valid_s=valid_s,
            device_time_s=device_s,
        )

    def _speed(self, width_m: float, velocity: float, at_s: float) -> float:
        o, before = self._options, self._before
        self._before = (at_s, width_m)
        if math.isfinite(velocity):
            return velocity * o.stroke_m / abs(o.open_position - o.closed_position)
        return 0.0 if before is None or at_s <= before[0] else (width_m - before[1]) / (at_s - before[0])

    def _held_n(self) -> float | None:
        """Return the force of the last goal, in N, if it ended because the jaws stalled on something."""
        answer = None if self._goal is None else self.answer(self._goal[0])
        values = None if answer is None else answer.get("values")
        if self._goal is None or not isinstance(values, dict) or values.get("stalled") is not True:
            return None
        return self._goal[1]


@takes(Ros2GripperOptions)
def connect(context: Context, options: dict[str, Any]) -> Ros2Gripper:
    """Entry point `ros2:gripper`."""
    device = Ros2Gripper(context, read_options(context, options, Ros2GripperOptions))
    device.join()
    return device
