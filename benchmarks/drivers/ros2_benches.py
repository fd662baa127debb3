"""Test setups of the drivers behind rosbridge."""

from __future__ import annotations

from benchmarks.drivers.bench import WITHOUT_ECHO, Bench
from benchmarks.drivers.truths import MovingArm, TimedForceTorque, taken_s, true_joints, true_width, true_wrench
from drivers.emulators import ros2, scripted

ROS2_BENCHES = (
    Bench(
        name="ros2 arm",
        start=ros2.start,
        backing=MovingArm,
        driver="ros2:arm",
        taken_s=taken_s,
        stamps="taken",
        is_true=true_joints,
        faults=WITHOUT_ECHO,
    ),
    Bench(
        name="ros2 force_torque",
        start=ros2.start,
        backing=TimedForceTorque,
        driver="ros2:force_torque",
        taken_s=taken_s,
        stamps="taken",
        is_true=true_wrench,
        faults=WITHOUT_ECHO,
    ),
    Bench(
        name="ros2 gripper",
        start=ros2.start,
        backing=lambda: scripted.ScriptedGripper(object_m=0.04),
        driver="ros2:gripper",
        is_true=true_width,
        faults=WITHOUT_ECHO,
    ),
)
