"""ROS 2 nodes that the emulated rosbridge serves: controllers and broadcasters of ros2_control over any device."""

from __future__ import annotations

import math
import time
from typing import Any, Protocol

import numpy as np

from drivers.emulators.base import BACKING_S, time_of
from drivers.kinds.arms import kinematics_of
from drivers.ros2.messages import GRIPPER_COMMAND, JOINT_STATE, JOINT_TRAJECTORY, NANO, POSITIONS, WRENCH_STAMPED
from hal.arrays import Array
from hal.clock import Deadline, WallClock
from hal.devices import Arm, ForceTorque, Gripper

EPOCH_S = 1_760_000_000  # ROS time is UTC; this one is an arbitrary start plus the monotonic clock
OTHER_JOINT = "other_joint"  # joint states hold joints of other devices too
TRAJECTORY_TOPIC = "/joint_trajectory_controller/joint_trajectory"
POSITIONS_TOPIC = "/forward_position_controller/commands"
CONTROLLER, SWITCH = "joint_trajectory_controller", "/controller_manager/switch_controller"
CLOSED_RAD, OPEN_RAD = 0.8, 0.0
GRIPPER_JOINT, GRIPPER_ACTION = "finger_joint", "/gripper_controller/gripper_cmd"
SUCCEEDED, ABORTED = 4, 6  # action_msgs/GoalStatus
Message = dict[str, Any]


class Node(Protocol):
    """Publishers, subscribers, services and actions of one emulated device."""

    outputs: dict[str, str]
    inputs: dict[str, str]

    def options(self) -> dict[str, Any]:
        """Return the driver's options for this node."""
        ...

    def tick(self) -> list[tuple[str, Message]]:
        """Do the periodic work; return the messages to publish, with their topics."""
        ...

    def take(self, topic: str, message: Message) -> None:
        """Take a message on one of `inputs`."""
        ...

    def serve(self, service: str, args: Message) -> Message | None:
        """Return the answer of a service; None when there is no such service."""
        ...

    def begin_goal(self, action: str, goal_id: str, args: Message) -> bool:
        """Begin an action's goal; return whether there is such an action."""
        ...

    def ended_goals(self) -> list[tuple[str, int, Message]]:
        """Return id, status and result of the goals that have ended since the last call."""
        ...


class BareNode:
    """Node without subscribers, services and actions."""

    def __init__(self) -> None:
        self.outputs: dict[str, str] = {}
        self.inputs: dict[str, str] = {}
        self._clock = WallClock()

    def take(self, topic: str, message: Message) -> None:
        """Ignore the message."""

    def serve(self, service: str, args: Message) -> Message | None:  # noqa: ARG002  # none is known
        """Return None."""
        return None

    def begin_goal(self, action: str, goal_id: str, args: Message) -> bool:  # noqa: ARG002  # none is known
        """Return False."""
        return False

    def ended_goals(self) -> list[tuple[str, int, Message]]:
        """Return none."""
        return []

    def deadline(self) -> Deadline:
        """Return a deadline for one call of the backing device."""
        return Deadline.after(self._clock, BACKING_S)


def header(frame: str = "base_link") -> Message:
    """Return a header stamped now."""
    nanoseconds = round((EPOCH_S + time.monotonic()) / NANO)
    return {"stamp": {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}, "frame_id": frame}


def joint_state(names: list[str], position: list[float], velocity: list[float], effort: list[float]) -> Message:
    """Return a JointState in alphabetic order, as joint_state_broadcaster sends it, with a joint of another device."""
    order = sorted(range(len(names)), key=lambda i: names[i])
    return {
        "header": header(),
        "name": [OTHER_JOINT, *(names[i] for i in order)],
        **{
            key: [0.25, *(values[i] for i in order)]
            for key, values in (("position", position), ("velocity", velocity), ("effort", effort))
        },
    }


class ArmNode(BareNode):
    """Joint_state_broadcaster, joint_trajectory_controller and forward_command_controller of an arm.

    Args:
        is_active: whether the trajectory controller is active from the beginning; else `switch_controller` activates it.
    """

    def __init__(self, backing: Arm, *, is_active: bool) -> None:
        super().__init__()
        self._backing = backing
        count = len(backing.capabilities().links)
        # Their alphabetic order is not that of the chain, as with shoulder, elbow and wrist.
        self.joints = [f"joint_{chr(ord('a') + (count - i) % count)}" for i in range(count)]
        self.outputs = {"/joint_states": JOINT_STATE}
        self.inputs = {TRAJECTORY_TOPIC: JOINT_TRAJECTORY, POSITIONS_TOPIC: POSITIONS}
        self.is_active = is_active
        self.trajectories = 0
        self._path: tuple[float, float, Array, Array] | None = None  # begin, duration, from, to
        self._desired: Array | None = None
        self._device_s = 0.0

    def options(self) -> dict[str, Any]:
        """Return the names of the joints, and the kinematics of the backing arm."""
        return {"joints": list(self.joints), "kinematics": kinematics_of(self._backing.capabilities())}

    def tick(self) -> list[tuple[str, Message]]:
        """Move along the trajectory, or hold its end, and publish the joint states."""
        sample = self._backing.read_state(deadline=self.deadline())
        self._device_s, state = time_of(sample), sample.value
        if self.is_active and self._path is not None:
            begun_s, lasts_s, start, goal = self._path
            part = 1.0 if lasts_s <= 0.0 else min(max((self._device_s - begun_s) / lasts_s, 0.0), 1.0)
            self._desired = start + part * (goal - start)
            self._backing.command_position(self._desired, deadline=self.deadline())
        position, velocity = [float(q) for q in state.position_rad], [float(v) for v in state.velocity_rad_per_s]
        return [("/joint_states", joint_state(self.joints, position, velocity, [0.0] * len(self.joints)))]

    def take(self, topic: str, message: Message) -> None:
        """Replace the trajectory; one that is not for exactly these joints is rejected, as by the controller."""
        if topic == POSITIONS_TOPIC:
            self._follow(np.array(message["data"], dtype=float), 0.0)
            return
        if sorted(message["joint_names"]) != sorted(self.joints) or len(message["points"]) != 1:
            return
        point, duration = message["points"][0], message["points"][0]["time_from_start"]
        places = [message["joint_names"].index(name) for name in self.joints]
        goal = np.array(point["positions"], dtype=float)[places]
        self._follow(goal, duration["sec"] + NANO * duration["nanosec"])

    def _follow(self, goal: Array, lasts_s: float) -> None:
        if not self.is_active:
            return
        if self._desired is None:
            self._backing.enable(deadline=self.deadline())
            self._desired = self._backing.read_state(deadline=self.deadline()).value.position_rad
        self._path = (self._device_s, lasts_s, self._desired, goal)
        self.trajectories += 1

    def serve(self, service: str, args: Message) -> Message | None:
        """Switch the trajectory controller."""
        if service != SWITCH:
            return None
        is_known = set(args["activate_controllers"]) | set(args["deactivate_controllers"]) <= {CONTROLLER}
        if is_known and CONTROLLER in args["activate_controllers"]:
            self.is_active = True
        return {"ok": is_known}


class GripperNode(BareNode):
    """Gripper_action_controller and the joint states of a gripper."""

    def __init__(self, backing: Gripper) -> None:
        super().__init__()
        self._backing = backing
        self.outputs = {"/joint_states": JOINT_STATE}
        self.actions = {GRIPPER_ACTION: GRIPPER_COMMAND}
        self._goal: str | None = None
        self._ended: list[tuple[str, int, Message]] = []

    def options(self) -> dict[str, Any]:
        """Return the joint, and the stroke of the backing gripper."""
        c = self._backing.capabilities()
        return {"joint": GRIPPER_JOINT, "stroke_m": c.max_width_m, "max_force_n": c.max_force_n}

    def tick(self) -> list[tuple[str, Message]]:
        """Publish the joint, and end the goal when the jaws rest."""
        state, width_m = (
            self._backing.read_state(deadline=self.deadline()).value,
            self._backing.capabilities().max_width_m,
        )
        position = CLOSED_RAD + state.width_m / width_m * (OPEN_RAD - CLOSED_RAD)
        if self._goal is not None and not state.is_moving:
            result = {"position": position, "effort": state.force_n, "stalled": state.is_holding}
            self._ended.append((self._goal, SUCCEEDED, {**result, "reached_goal": not state.is_holding}))
            self._goal = None
        velocity = 0.5 if state.is_moving else 0.0
        return [("/joint_states", joint_state([GRIPPER_JOINT], [position], [velocity], [state.force_n]))]

    def begin_goal(self, action: str, goal_id: str, args: Message) -> bool:
        """Move the jaws; the goal before is aborted."""
        if action != GRIPPER_ACTION:
            return False
        if self._goal is not None:
            self._ended.append((self._goal, ABORTED, {}))
        c, command = self._backing.capabilities(), args["command"]
        part = (command["position"] - CLOSED_RAD) / (OPEN_RAD - CLOSED_RAD)
        self._backing.command(
            width_m=min(max(part, 0.0), 1.0) * c.max_width_m,
            force_n=min(command["max_effort"], c.max_force_n),
            speed_m_per_s=c.max_speed_m_per_s,
            deadline=self.deadline(),
        )
        self._goal = goal_id
        return True

    def ended_goals(self) -> list[tuple[str, int, Message]]:
        """Return the goals that have ended."""
        ended, self._ended = self._ended, []
        return ended


class ForceTorqueNode(BareNode):
    """Force_torque_sensor_broadcaster."""

    def __init__(self, backing: ForceTorque) -> None:
        super().__init__()
        self._backing = backing
        self.outputs = {"/force_torque_sensor_broadcaster/wrench": WRENCH_STAMPED}

    def options(self) -> dict[str, Any]:
        """Return the measuring range of the backing sensor."""
        c = self._backing.capabilities()
        return {
            "force_range_n": c.force_range_n,
            "torque_range_nm": c.torque_range_nm,
            "force_sigma_n": c.force_sigma_n,
            "torque_sigma_nm": c.torque_sigma_nm,
        }

    def tick(self) -> list[tuple[str, Message]]:
        """Publish the wrench."""
        value = self._backing.read_wrench(deadline=self.deadline()).value
        wrench = {
            part: {axis: float(v) if math.isfinite(v) else None for axis, v in zip("xyz", vector, strict=True)}
            for part, vector in (("force", value.force_n), ("torque", value.torque_nm))
        }
        topic = "/force_torque_sensor_broadcaster/wrench"
        return [(topic, {"header": header("ft_frame"), "wrench": wrench})]
