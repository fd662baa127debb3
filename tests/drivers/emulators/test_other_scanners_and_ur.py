"""Third-party clients of scanners and the UR controller with our emulators; see `test_other_sides` for the rest."""

import json
import math
import os
import pty
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.emulators import lms200, rplidar, scip, ur, ur_io
from drivers.emulators.beams import line_m
from drivers.emulators.scripted import ScriptedArm, ScriptedLights, ScriptedScanner, ScriptedTouch, scripted_scan
from hal.devices import RangeImage
from tests.drivers.rigs import until

UR_CLIENT = """
import json
from dashboard_client import DashboardClient
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

names = ["timestamp", "actual_q", "actual_qd", "target_q", "robot_mode", "safety_mode", "runtime_state", "speed_scaling"]
receive = RTDEReceiveInterface("127.0.0.1", 125.0, names)
dashboard = DashboardClient("127.0.0.1")
dashboard.connect()
io = RTDEIOInterface("127.0.0.1")
seen = {
    "position_rad": list(receive.getActualQ()),
    "modes": [receive.getRobotMode(), receive.getSafetyMode()],
    "dashboard": [dashboard.robotmode(), dashboard.safetystatus(), dashboard.polyscopeVersion()],
    "slider": io.setSpeedSlider(0.5),
}
dashboard.stop()
for client in (io, dashboard, receive):
    client.disconnect()
print(json.dumps(seen))
"""

UR_IO_CLIENT = """
import sys
from rtde_io import RTDEIOInterface
from rtde_receive import RTDEReceiveInterface

inputs, outputs, *switched = map(int, sys.argv[1:])
names = ["timestamp", "actual_digital_input_bits", "actual_digital_output_bits"]
receive = RTDEReceiveInterface("127.0.0.1", 125.0, names)
io = RTDEIOInterface("127.0.0.1")
assert all(io.setStandardDigitalOut(output, True) for output in switched)
while (receive.getActualDigitalInputBits(), receive.getActualDigitalOutputBits()) != (inputs, outputs):
    pass
for client in (io, receive):
    client.disconnect()
"""

GRABBER_INI = """
[global]
rawlog_prefix = {folder}/scan
time_between_launches = 0
SF_max_time_span = 0.1
use_sensoryframes = 0
GRABBER_PERIOD_MS = 200

[LASER]
driver = CSickLaserSerial
process_rate = 50
sensorLabel = LMS
COM_port_LIN = {port}
COM_baudRate = 38400
mm_mode = 1
FOV = 180
resolution = 100
pose_x = 0
pose_y = 0
pose_z = 0
pose_yaw = 0
pose_pitch = 0
pose_roll = 0
"""


def is_a_scan(range_m: Any, angle_rad: Any, *, step_m: float) -> bool:
    """Return whether the ranges are one of the scripted scans, to the resolution of the protocol."""
    caps = ScriptedScanner().capabilities()
    true_m = [line_m(RangeImage(depth_m=scripted_scan(k)), caps, np.asarray(angle_rad)) for k in range(100)]
    return any(np.allclose(range_m, m, atol=step_m) for m in true_m)


@pytest.mark.third_party("hokuyolx", "scip:scanner")
def test_hokuyolx_reads_parameters_and_scans() -> None:
    hokuyolx: Any = pytest.importorskip("hokuyolx")
    # One scan per 67 ms: if two arrive between its reads, this client takes them for one and reports a wrong checksum.
    far_side = scip.start(ScriptedScanner(), {"transport": "tcp", "scans_per_minute": 900})
    where = (far_side.address["host"], far_side.address["port"])
    laser = hokuyolx.HokuyoLX(addr=where, tsync=False, convert_time=False)
    try:
        assert (laser.amin, laser.amax, laser.aforw, laser.ares, laser.dmax) == (44, 725, 384, 1024, 4095)
        angle_rad = (np.arange(44, 726) - 384) * math.tau / 1024
        first_ms, scan_mm = laser.get_dist()
        assert is_a_scan(scan_mm / 1000, angle_rad, step_m=0.00051)
        stamps_ms = []
        for scan_mm, stamp_ms, _ in laser.iter_dist(scans=3):
            assert is_a_scan(scan_mm / 1000, angle_rad, step_m=0.00051)
            stamps_ms.append(stamp_ms)
        assert len(stamps_ms) == 3 and first_ms <= stamps_ms[0] <= stamps_ms[1] <= stamps_ms[2]
        laser.standby()
    finally:
        laser.close()
        far_side.close()


@pytest.mark.third_party("rplidar-roboticia", "serial:rplidar")
@pytest.mark.parametrize("mode", ["normal", "express"])
def test_rplidar_roboticia_reads_identity_health_and_nodes(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = pytest.importorskip("rplidar")
    far_side = rplidar.start(ScriptedScanner(), {"scan_rate_hz": 20.0})
    monkeypatch.setattr("serial.Serial.setDTR", lambda *_: None)  # a pty has no such line
    lidar = module.RPLidar(far_side.address["port"])
    try:
        assert lidar.get_health() == ("Good", 0)
        assert lidar.get_info()["model"] == 24
        turns: list[list[tuple[float, float]]] = [[]]
        for is_new, _, angle_deg, distance_mm in lidar.iter_measures(mode, max_buf_meas=False):
            if is_new:
                turns.append([])
            turns[-1].append((angle_deg, distance_mm))
            if len(turns) == 4:
                break
        assert all(is_seen(np.array(turn)) for turn in turns[1:3])
        lidar.stop()
    finally:
        lidar.disconnect()
        far_side.close()


def is_seen(turn: Any) -> bool:
    """Return whether a turn (N, 2) of degrees and millimetres is a scripted scan, to 1/64 degree or coarser."""
    away_from_seam = turn[np.abs(turn[:, 0] - 180.0) > 1.0]
    angle_rad = (np.deg2rad(away_from_seam[:, 0]) + np.pi) % math.tau - np.pi
    return is_a_scan(away_from_seam[:, 1] / 1000, angle_rad, step_m=0.0021)


@pytest.mark.third_party("ur-rtde", "ur:rtde")
def test_ur_rtde_reads_the_arm_and_asks_the_dashboard() -> None:
    """The clients hold the interpreter lock while they connect, so they run in a separate process."""
    pytest.importorskip("rtde_receive")
    arm = ScriptedArm()
    far_side = ur.start(arm, {"rtde_port": 30_004, "script_port": 30_002, "dashboard_port": 29_999})
    try:
        ran = subprocess.run([sys.executable, "-c", UR_CLIENT], capture_output=True, text=True, timeout=60, check=False)
        assert ran.returncode == 0, ran.stderr
        seen = json.loads(ran.stdout.splitlines()[-1])
        assert seen["position_rad"] == pytest.approx(arm.position_rad)
        assert seen["modes"] == [7, 1]
        assert seen["dashboard"] == ["Robotmode: RUNNING", "Safetystatus: NORMAL", "5.11.0.0"]
        assert seen["slider"] is True
        until(lambda: arm.stops > 0)
    finally:
        far_side.close()


def read_by_ur_rtde(*, inputs: int, outputs: int, switched: tuple[int, ...] = ()) -> None:
    """Switch outputs on with ur-rtde, and wait until it reads these bits of the inputs and the outputs."""
    arguments = map(str, (inputs, outputs, *switched))
    subprocess.run([sys.executable, "-c", UR_IO_CLIENT, *arguments], timeout=60, check=True)


@pytest.mark.third_party("ur-rtde", "ur:lights")
def test_ur_rtde_switches_the_lights_and_reads_their_feedback() -> None:
    pytest.importorskip("rtde_io")
    lights = ScriptedLights()
    far_side = ur_io.start(lights, {"port": 30_004})
    try:
        read_by_ur_rtde(inputs=0b1010, outputs=0b1010, switched=(1, 3))
        assert lights.on == (False, True, False, True)
    finally:
        far_side.close()


@pytest.mark.third_party("ur-rtde", "ur:touch")
def test_ur_rtde_reads_the_pads_at_the_inputs_of_the_tool() -> None:
    pytest.importorskip("rtde_io")
    pads = ScriptedTouch()
    pads.contacts = (False, True)
    far_side = ur_io.start(pads, {"port": 30_004})
    try:
        read_by_ur_rtde(inputs=1 << 17, outputs=0)
    finally:
        far_side.close()


@pytest.mark.third_party("mrpt-apps", "serial:lms200")
def test_rawlog_grabber_sets_up_the_lms_200_and_records_its_scans(tmp_path: Path) -> None:
    """The MRPT grabber finds the power-up baud rate, changes it, sets millimetres and streams; it needs a terminal."""
    if shutil.which("rawlog-grabber") is None:
        pytest.skip("rawlog-grabber is not installed (Debian package mrpt-apps)")
    far_side = lms200.start(ScriptedScanner(), {})
    (tmp_path / "lms.ini").write_text(GRABBER_INI.format(folder=tmp_path, port=far_side.address["port"]))
    keyboard, terminal = pty.openpty()
    command = ["rawlog-grabber", str(tmp_path / "lms.ini")]
    try:
        with subprocess.Popen(command, stdin=terminal, stdout=subprocess.PIPE, text=True) as grabber:
            saved = (line for line in grabber.stdout or () if "Saved" in line)
            for _ in range(5):
                next(saved)
            assert (far_side.baud, far_side.is_streaming) == (38_400, True)
            os.write(keyboard, b"\x1b")
            for _ in saved:  # read to the end, because the grabber is killed by a closed pipe
                pass
        assert grabber.returncode == 0
    finally:
        os.close(keyboard)
        os.close(terminal)
        far_side.close()
    log = next(tmp_path.glob("*.rawlog"))
    edit = ["rawlog-edit", "--export-2d-scans-txt", "--input", log.name]  # joins folder and name without a slash
    subprocess.run(edit, check=True, capture_output=True, cwd=tmp_path)
    rows = np.loadtxt(next(tmp_path.glob("*_LMS.txt")), comments="%")
    angle_rad = np.deg2rad(np.arange(181) - 90.0)
    assert len(rows) >= 10
    assert all(is_a_scan(row[1:182], angle_rad, step_m=0.00051) for row in rows)
