"""Tests of changing a device's driver while the cell runs: over HTTP, in a real cell process, with emulators."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import httpx2
import numpy as np
import psutil
import pytest

from drivers.emulators import dynamixel, modbus_io, tfmini
from drivers.emulators.scripted import ScriptedArm, ScriptedLights, ScriptedProximity
from hal.clock import Deadline, WallClock
from hal.config import load_cell
from hal.errors import DeviceUnavailable
from hal.motion import Hold
from service.processes.cell import CellRuntime
from service.processes.connection import PREFIX, SWAPPER
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS
from tests.service.waiting import eventually

SENSOR = "/v1/devices/finger_proximity"
CAMERA = "/v1/devices/wrist_camera"
WIRES = (
    '[safety]\nallowed_places = ["/dev/gone", "/dev/pts/*", "/*/panelwright-*"]'  # where the emulators of the tests are
)
SOON = Deadline.after(WallClock(), 3600.0)


@pytest.fixture(scope="module")
def sensors(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield a service with sensors in a separate cell process."""
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), warm=False)
    panelwright = Panelwright(load_cell(write_module_cell(mode="real", extra=WIRES)), options, operations=OPERATIONS)
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture
def http(sensors: Panelwright) -> Iterator[httpx2.Client]:
    """Yield a client; each test begins with the fakes as drivers."""
    with httpx2.Client(base_url=sensors.url, timeout=30.0, trust_env=False) as http:
        for name, kind in (("finger_proximity", "proximity"), ("panel_lights", "lights")):
            answer = http.put(f"/v1/devices/{name}", json={"driver": f"fake:{kind}"})
            assert answer.status_code == 200, answer.text
        yield http


@pytest.fixture
def far_side() -> Iterator[Any]:
    """Yield an emulated TFmini on a pseudo terminal."""
    emulator = tfmini.start(ScriptedProximity(fixed_m=0.456), {})
    yield emulator
    emulator.close()


def block(far_side: Any, driver: str = "serial:tfmini") -> dict[str, Any]:
    return {"driver": driver, "options": far_side.address}


def value(http: httpx2.Client) -> float:
    reading = http.get(f"{SENSOR}/reading").json()
    assert reading["quality"] == "valid"
    return float(reading["value"])


def test_a_wired_device_takes_the_place_of_another_and_gives_it_back(http: httpx2.Client, far_side: Any) -> None:
    assert value(http) == 0.123
    answer = http.put(SENSOR, json=block(far_side))
    assert answer.status_code == 200, answer.text
    assert (answer.json()["driver"], answer.json()["options"]) == ("serial:tfmini", far_side.address)
    assert answer.json()["health"]["connected"]
    assert value(http) == pytest.approx(0.456)
    assert http.post(f"{SENSOR}/fault", json={"fault": "silent"}).status_code == 409, "it is real now"
    assert http.put(SENSOR, json={"driver": "fake:proximity"}).status_code == 200
    assert value(http) == 0.123


@pytest.mark.parametrize("driver", ["serial:tfmini", "modbus:lights", "somebody:elses"])
@pytest.mark.parametrize(
    "options",
    [
        {"port": "/etc/passwd"},
        {"port": "/dev/pts/../../etc/passwd"},
        {"port": "spy:///dev/pts/0?file=/etc/shadow"},
        {"host": "192.0.2.7"},
        {"host": "127.0.0.1", "port": 22},
        {"line": {"url": "tcp://192.0.2.7:80"}},
        {"secrets": "/etc/passwd"},
    ],
)
def test_no_client_leads_a_device_to_a_place_that_the_cell_file_does_not_allow(
    http: httpx2.Client, driver: str, options: dict[str, Any]
) -> None:
    answer = http.put(SENSOR, json={"driver": driver, "options": options})
    assert (answer.status_code, "safety.allowed_places" in answer.text) == (422, True), answer.text
    assert value(http) == 0.123


def test_a_strangers_port_is_not_connected_to(http: httpx2.Client) -> None:
    with socket.create_server(("127.0.0.1", 0)) as stranger:
        options = {"host": "127.0.0.1", "port": stranger.getsockname()[1]}
        for driver in ("udp:netft", "modbus:lights", "ur:rtde"):
            assert http.put("/v1/devices/panel_lights", json={"driver": driver, "options": options}).status_code == 422
        stranger.setblocking(False)
        with pytest.raises(BlockingIOError):
            stranger.accept()


def test_the_other_devices_go_on_meanwhile(http: httpx2.Client, far_side: Any) -> None:
    is_over, sequences = threading.Event(), list[int]()

    def watch() -> None:
        while not is_over.is_set():
            answer = http.get("/v1/devices/panel_lights/reading")
            assert answer.status_code == 200, answer.text
            sequences.append(answer.json()["sequence"])

    with ThreadPoolExecutor(1) as pool:
        watching = pool.submit(watch)
        for _ in range(5):
            assert http.put(SENSOR, json=block(far_side)).status_code == 200
            assert http.put(SENSOR, json={"driver": "fake:proximity"}).status_code == 200
        is_over.set()
        watching.result(30.0)
    assert len(sequences) > 5
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


@pytest.mark.parametrize(
    ("sent", "status", "says"),
    [
        ({"driver": "serial:tfmini", "options": {"port": "/dev/gone"}}, 503, "port /dev/gone does not exist"),
        ({"driver": "serial:tfmimi"}, 422, "no driver called 'serial:tfmimi'"),
        ({"driver": "serial:tfmini", "options": {"prot": "x"}}, 422, "unknown key 'prot'"),
        ({"driver": "fake:lights"}, 422, "is a lights, not a proximity"),
        ({"driver": "fake:proximity", "options": {"crash_at_connect": True}}, 503, "ZeroDivisionError"),
    ],
)
def test_the_old_device_is_kept_when_the_new_one_does_not_connect(
    http: httpx2.Client, sent: dict[str, Any], status: int, says: str
) -> None:
    answer = http.put(SENSOR, json=sent)
    problem = answer.json()
    assert (answer.status_code, problem["details"]["kept"]) == (status, "fake:proximity"), problem
    assert problem["detail"].startswith("finger_proximity keeps fake:proximity")
    assert says in problem["detail"]
    assert http.get(SENSOR).json()["driver"] == "fake:proximity"
    assert value(http) == 0.123


@pytest.fixture
def recordings(sensors: Panelwright, http: httpx2.Client) -> Iterator[Path]:
    """Yield the folder of recordings, with a video of two frames; afterwards the fake camera is restored."""
    folder = sensors.service.runs_dir / "recordings"
    (folder / "film").mkdir(parents=True, exist_ok=True)
    for number in range(2):
        cv2.imwrite(str(folder / "film" / f"{number}.png"), np.full((8, 10, 3), 40 * number, np.uint8))
    yield folder
    assert http.put(CAMERA, json={"driver": "fake:camera"}).status_code == 200


def test_a_recording_takes_the_place_of_a_camera(http: httpx2.Client, recordings: Path) -> None:
    for path in ("film", str(recordings / "film")):
        answer = http.put(CAMERA, json={"driver": "files:camera", "options": {"path": path}})
        assert answer.status_code == 200, answer.text
        png = np.frombuffer(http.get(f"{CAMERA}/reading?format=png").content, np.uint8)
        assert cv2.imdecode(png, cv2.IMREAD_COLOR).shape == (8, 10, 3)


@pytest.mark.parametrize(
    ("driver", "option", "path"),
    [
        ("files:camera", "path", "/etc"),
        ("files:camera", "path", ".."),
        ("files:depth", "path", "film/../../elsewhere"),
        ("files:camera", "path", "link"),
        ("serial:tfmini", "replay", "/etc/passwd"),
        ("fake:camera", "replay", "/etc/passwd"),  # does not name its options
    ],
)
def test_no_other_file_of_the_machine_is_opened(
    http: httpx2.Client, recordings: Path, driver: str, option: str, path: str
) -> None:
    link = recordings / "link"
    link.symlink_to("/etc")
    try:
        answer = http.put(CAMERA, json={"driver": driver, "options": {option: path}})
    finally:
        link.unlink()
    problem = answer.json()
    assert answer.status_code == 422 and f"options.{option}" in problem["detail"], problem
    assert problem["details"]["folder"] == str(recordings.resolve())
    assert http.get(CAMERA).json()["driver"] == "fake:camera"


def test_a_device_on_the_same_port_is_let_in_after_the_old_one_and_comes_back_if_it_must(http: httpx2.Client) -> None:
    far_side = modbus_io.start(ScriptedLights(), {"transport": "rtu"})
    try:
        lights = block(far_side, "modbus:lights")
        assert http.put("/v1/devices/panel_lights", json=lights).status_code == 200
        other = {**lights, "options": {**lights["options"], "baud": 9600}}
        assert http.put("/v1/devices/panel_lights", json=other).status_code == 200
        wrong = {**lights, "options": {**lights["options"], "unit": 99}}
        answer = http.put("/v1/devices/panel_lights", json=wrong)
        assert answer.status_code == 503
        assert answer.json()["details"]["kept"] == "modbus:lights"
        assert http.get("/v1/devices/panel_lights").json()["options"]["baud"] == 9600
        assert http.get("/v1/devices/panel_lights/reading").json()["quality"] == "valid"
    finally:
        far_side.close()


def test_what_a_swap_may_not_change_or_do_is_refused(http: httpx2.Client) -> None:
    for sent, says in (
        ({"driver": "fake:proximity", "kind": "lights"}, "stays a proximity"),
        ({"driver": "fake:proximity", "mount": {"calibration": "other"}}, "stays a proximity"),
        ({"driver": "fake:proximity", "options": {"capture": "/somewhere"}}, "captures cannot be started over HTTP"),
        ({"driver": "no colon"}, "body.driver"),
        ({"driver": "fake:proximity", "rate": 1}, "body.rate"),
        ({}, "body.driver"),
    ):
        answer = http.put(SENSOR, json=sent)
        assert answer.status_code == 422
        assert says in answer.json()["detail"], answer.text
    assert http.put("/v1/devices/nobody", json={"driver": "fake:proximity"}).status_code == 404


def test_only_the_holder_of_the_lease_swaps(http: httpx2.Client) -> None:
    token = http.post("/v1/lease", json={"holder": "alice"}).json()["token"]
    assert http.put(SENSOR, json={"driver": "fake:proximity"}).status_code == 409
    answer = http.put(SENSOR, json={"driver": "fake:proximity"}, headers={"Lease-Token": token})
    assert answer.status_code == 200
    http.post("/v1/lease/release", headers={"Lease-Token": token})


def test_many_swaps_leave_no_descriptor_and_no_thread(http: httpx2.Client, sensors: Panelwright, far_side: Any) -> None:
    def swap_twice() -> None:
        assert http.put(SENSOR, json=block(far_side)).status_code == 200
        assert value(http) == pytest.approx(0.456)
        assert http.put(SENSOR, json={"driver": "fake:proximity"}).status_code == 200
        assert value(http) == 0.123

    pid = sensors.service.supervisor.processes()[0].pid
    cell, own = psutil.Process(pid), psutil.Process()
    for _ in range(8):  # each thread of the service opens its own connections
        swap_twice()
    before = (cell.num_fds(), cell.num_threads(), own.num_fds())
    for _ in range(10):
        swap_twice()
    after = (cell.num_fds(), cell.num_threads(), own.num_fds())
    spare = 12  # six threads of the service may not have connected to the newest device yet
    assert all(b <= a + spare for a, b in zip(before, after, strict=True)), (before, after)


def test_the_swapped_device_is_there_again_after_a_restart_of_the_cell_process(
    http: httpx2.Client, sensors: Panelwright, far_side: Any
) -> None:
    assert http.put(SENSOR, json=block(far_side)).status_code == 200
    pid = sensors.service.supervisor.processes()[0].pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    eventually(lambda: sensors.service.supervisor.processes()[0].restarts == 1)
    eventually(lambda: sensors.service.supervisor.is_ready)
    assert http.get(SENSOR).json()["driver"] == "serial:tfmini"
    assert value(http) == pytest.approx(0.456)
    assert http.get("/v1/stop").json()["is_latched"]
    http.post("/v1/stop/reset", json={"seen_count": http.get("/v1/stop").json()["count"]})


@pytest.fixture(scope="module")
def robot(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield an inline cell with an arm."""
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True, warm=False)
    panelwright = Panelwright(
        load_cell(write_module_cell(robot=True, mode="real", extra=WIRES)), options, operations=OPERATIONS
    )
    panelwright.start()
    supervisor = panelwright.service.supervisor
    supervisor.reset("test", seen_count=supervisor.latch.state().count)
    yield panelwright
    panelwright.close()


def test_motion_power_is_off_after_a_swap_of_the_arm_until_the_next_motion(robot: Panelwright) -> None:
    arm = ScriptedArm()
    far_side = dynamixel.start(arm, {})
    mover = robot.service.supervisor.connection.mover
    with httpx2.Client(base_url=robot.url, timeout=30.0, trust_env=False) as http:
        try:
            assert http.put("/v1/devices/arm", json=block(far_side, "serial:dynamixel")).status_code == 200
            assert not arm.is_enabled
            assert mover.state().position_rad == pytest.approx(arm.position_rad, abs=1e-3)
            assert mover.execute(Hold(name="hold", duration_s=0.05)).outcome == "completed"
            assert arm.is_enabled
            assert http.put("/v1/devices/arm", json=block(far_side, "serial:dynamixel")).status_code == 200
            assert mover.state().faults == ()
            assert not robot.service.supervisor.connection.device("arm").read_state(deadline=SOON).value.is_enabled
        finally:
            assert http.put("/v1/devices/arm", json={"driver": "fake:arm"}).status_code == 200
            far_side.close()
    assert mover.execute(Hold(name="hold", duration_s=0.05)).outcome == "completed"


def test_no_device_of_the_motion_is_swapped_while_one_runs(robot: Panelwright) -> None:
    mover = robot.service.supervisor.connection.mover
    with ThreadPoolExecutor(1) as pool, httpx2.Client(base_url=robot.url, timeout=30.0, trust_env=False) as http:
        running = pool.submit(mover.execute, Hold(name="hold", duration_s=60.0))
        eventually(lambda: mover.state().is_moving)
        for name, kind in (("arm", "arm"), ("gripper", "gripper"), ("wrist_ft", "force_torque")):
            answer = http.put(f"/v1/devices/{name}", json={"driver": f"fake:{kind}"})
            assert (answer.status_code, answer.json()["type"]) == (409, "urn:panelwright:motion-refused")
        assert http.put("/v1/devices/wrist_camera", json={"driver": "fake:camera"}).status_code == 200
        assert not running.done()
        mover.cancel()
        assert running.result(20.0).outcome == "cancelled"
        assert http.put("/v1/devices/wrist_ft", json={"driver": "fake:force_torque"}).status_code == 200


def test_an_arm_that_the_control_thread_cannot_take_is_given_back(robot: Panelwright) -> None:
    far_side = dynamixel.start(ScriptedArm(), {})
    whole = far_side.address["kinematics"]
    two = {key: value[:2] if isinstance(value, list) else value for key, value in whole.items()}
    options = {**far_side.address, "ids": [1, 2], "kinematics": two}
    with httpx2.Client(base_url=robot.url, timeout=30.0, trust_env=False) as http:
        answer = http.put("/v1/devices/arm", json={"driver": "serial:dynamixel", "options": options})
        assert (answer.status_code, answer.json()["details"]["kept"]) == (422, "fake:arm")
        assert "2 joints" in answer.json()["detail"]
    far_side.close()
    mover = robot.service.supervisor.connection.mover
    assert mover.execute(Hold(name="hold", duration_s=0.05)).outcome == "completed"


EMULATED = """
[devices.left]
kind = "proximity"
driver = "serial:tfmini"
[emulators.left]
emulator = "tfmini"
driver = "fake:proximity"
"""


def test_an_address_that_is_given_is_not_replaced_by_the_emulators(write_cell: WriteCell, far_side: Any) -> None:
    cell = load_cell(write_cell(mode="mixed", extra=EMULATED))
    runtime = CellRuntime.start(cell, is_latched=lambda: False)
    try:
        swapper, left = runtime.objects[PREFIX + SWAPPER], runtime.objects["left"]
        swapper.swap("left", "serial:tfmini", far_side.address, deadline=SOON)
        assert left.read_distance_m(deadline=SOON).value == pytest.approx(0.456)
        with pytest.raises(DeviceUnavailable, match=r"/dev/gone does not exist"):
            swapper.swap("left", "serial:tfmini", {"port": "/dev/gone"}, deadline=SOON)
        assert left.read_distance_m(deadline=SOON).value == pytest.approx(0.456), "the old one is kept, where it was"
        swapper.swap("left", "serial:tfmini", {"unit": "mm"}, deadline=SOON)
        assert left.read_distance_m(deadline=SOON).value == pytest.approx(0.123), (
            "without an address it is the emulator"
        )
    finally:
        runtime.close()
    again = CellRuntime.start(
        load_cell(write_cell(mode="mixed", extra=EMULATED)),
        is_latched=lambda: False,
        swapped={"left": cell.file.devices["left"].model_copy(update={"options": far_side.address})},
    )
    try:
        assert again.objects["left"].read_distance_m(deadline=SOON).value == pytest.approx(0.456), "after a restart too"
    finally:
        again.close()
