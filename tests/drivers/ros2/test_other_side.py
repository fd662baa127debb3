"""A third party's client of rosbridge (roslibpy) with our emulator, so that the emulator rests on more than our driver."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

from drivers.emulators import ros2
from drivers.emulators.scripted import ScriptedArm, ScriptedForceTorque, ScriptedGripper, scripted_wrench

CLIENT = """
import json
import sys
import threading

import roslibpy

port, joints = int(sys.argv[1]), sys.argv[2:]
ros = roslibpy.Ros("127.0.0.1", port)
ros.run(timeout=20)
place, news = {}, threading.Condition()


def take(message):
    with news:
        place.update(zip(message["name"], message["position"]))
        news.notify_all()


states = roslibpy.Topic(ros, "/joint_states", "sensor_msgs/JointState", queue_length=1)
states.subscribe(take)
with news:
    assert news.wait_for(lambda: joints[0] in place, 20)
    goal = {name: place[name] + 0.05 for name in joints}
commands = roslibpy.Topic(ros, "/joint_trajectory_controller/joint_trajectory", "trajectory_msgs/JointTrajectory")
commands.advertise()
point = {"positions": list(goal.values()), "time_from_start": {"sec": 0, "nanosec": 50_000_000}}
commands.publish(roslibpy.Message({"joint_names": list(goal), "points": [point]}))
with news:
    has_moved = news.wait_for(lambda: all(abs(place[name] - goal[name]) < 1e-9 for name in joints), 20)
switch = roslibpy.Service(ros, "/controller_manager/switch_controller", "controller_manager_msgs/SwitchController")
args = {"activate_controllers": ["joint_trajectory_controller"], "deactivate_controllers": []}
answer = switch.call(roslibpy.ServiceRequest(args), timeout=20)
print(json.dumps({"has_moved": has_moved, "is_switched": answer["ok"]}))
ros.terminate()
"""
ACTION_CLIENT = """
import json
import sys
import threading

import roslibpy

ros = roslibpy.Ros("127.0.0.1", int(sys.argv[1]))
ros.run(timeout=20)
action = roslibpy.ActionClient(ros, "/gripper_controller/gripper_cmd", "control_msgs/action/GripperCommand")
done, results = threading.Event(), []


def take(result):
    results.append(dict(result))
    done.set()


goal = roslibpy.Goal({"command": {"position": 0.8, "max_effort": 20.0}})
action.send_goal(goal, take, lambda feedback: None, lambda error: None)
done.wait(20)
print(json.dumps(results, default=str))
ros.terminate()
"""
WRENCH_CLIENT = """
import json
import sys
import threading

import roslibpy

ros = roslibpy.Ros("127.0.0.1", int(sys.argv[1]))
ros.run(timeout=20)
seen, is_enough = [], threading.Event()


def take(message):
    seen.append([message["wrench"][part][axis] for part in ("force", "torque") for axis in "xyz"])
    if len(seen) == 5:
        is_enough.set()


topic = roslibpy.Topic(ros, "/force_torque_sensor_broadcaster/wrench", "geometry_msgs/WrenchStamped")
topic.subscribe(take)
is_enough.wait(20)
print(json.dumps(seen[:5]))
ros.terminate()
"""


def run_client(program: str, *arguments: str) -> str:
    run = subprocess.run(
        [sys.executable, "-c", program, *arguments], capture_output=True, text=True, timeout=90, check=False
    )
    assert run.returncode == 0, run.stderr
    return run.stdout


@pytest.mark.third_party("roslibpy", "ros2:arm")
def test_a_client_of_others_moves_the_emulated_arm_and_switches_its_controller() -> None:
    arm = ScriptedArm()
    before = arm.position_rad.copy()
    far_side = ros2.start(arm, {})
    try:
        said = json.loads(run_client(CLIENT, str(far_side.address["port"]), *far_side.address["joints"]))
        assert said == {"has_moved": True, "is_switched": True}
        np.testing.assert_allclose(arm.position_rad - before, 0.05, atol=1e-9)
    finally:
        far_side.close()


@pytest.mark.third_party("roslibpy", "ros2:gripper")
def test_a_client_of_others_closes_the_emulated_gripper_by_the_action() -> None:
    gripper = ScriptedGripper()
    gripper.object_m = 0.03
    far_side = ros2.start(gripper, {})
    try:
        [result] = json.loads(run_client(ACTION_CLIENT, str(far_side.address["port"])))
        assert result["values"]["stalled"] is True and result["values"]["reached_goal"] is False
    finally:
        far_side.close()


@pytest.mark.third_party("roslibpy", "ros2:force_torque")
def test_a_client_of_others_hears_the_emulated_wrench() -> None:
    far_side = ros2.start(ScriptedForceTorque(), {})
    try:
        heard = json.loads(run_client(WRENCH_CLIENT, str(far_side.address["port"])))
    finally:
        far_side.close()
    first = round(heard[0][0] / 0.01)  # the force tells which reading it is
    for index, wrench in enumerate(heard):
        true = scripted_wrench(first + index)
        np.testing.assert_allclose(wrench, [*true.force_n, *true.torque_nm], atol=1e-9)
