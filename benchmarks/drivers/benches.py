"""Test setups of all drivers with emulators: how they are started, their options, and how values are checked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.drivers.bench import WITHOUT_CRC, Bench
from benchmarks.drivers.camera_benches import CAMERA_BENCHES
from benchmarks.drivers.gige_bench import GIGE_BENCHES
from benchmarks.drivers.local_cameras import LOCAL_BENCHES
from benchmarks.drivers.ros2_benches import ROS2_BENCHES
from benchmarks.drivers.truths import (
    MovingArm,
    TimedForceTorque,
    TimedProximity,
    TimedTouch,
    is_near,
    scip_angles,
    sick_angles,
    taken_s,
    true_centimetres,
    true_contacts,
    true_distance,
    true_express,
    true_joints,
    true_lights,
    true_reading,
    true_scan,
    true_width,
    true_wrench,
    turn_angles,
)
from drivers.emulators import (
    bota,
    cia402,
    dynamixel,
    dynamixel_gripper,
    ft300,
    lms200,
    modbus_io,
    netft,
    robotiq_2f,
    rplidar,
    scip,
    scripted,
    tfmini,
    tfmini_i,
    ur,
    ur_io,
)
from hal.registry import Context, connect

FAST_SCAN = {"scans_per_minute": 2400}
BENCHES = (
    Bench(
        name="tfmini",
        start=tfmini.start,
        backing=scripted.ScriptedProximity,
        driver="serial:tfmini",
        is_true=true_distance,
    ),
    Bench(
        name="tfmini modbus",
        start=tfmini_i.start_modbus,
        backing=TimedProximity,
        driver="modbus:tfmini",
        is_true=true_reading,
        taken_s=taken_s,
        stamps="taken",
    ),
    Bench(
        name="tfmini can",
        start=tfmini_i.start_can,
        backing=scripted.ScriptedProximity,
        driver="can:tfmini",
        is_true=true_centimetres,
        faults=WITHOUT_CRC,
    ),
    Bench(
        name="tfmini virtual can",
        start=tfmini_i.start_can,
        backing=scripted.ScriptedProximity,
        driver="can:tfmini",
        is_true=true_centimetres,
        far_options={"transport": "virtual"},
        faults=WITHOUT_CRC,
        stamps="own log",
    ),
    Bench(
        name="ft300 stream",
        start=ft300.start,
        backing=TimedForceTorque,
        driver="serial:ft300",
        is_true=true_wrench,
    ),
    Bench(
        name="ft300 modbus",
        start=ft300.start,
        backing=TimedForceTorque,
        driver="modbus:ft300",
        taken_s=taken_s,
        is_true=true_wrench,
        stamps="taken",
    ),
    Bench(
        name="robotiq_2f",
        start=robotiq_2f.start,
        backing=lambda: scripted.ScriptedGripper(object_m=0.04),
        driver="modbus:robotiq_2f",
        is_true=true_width,
    ),
    Bench(
        name="modbus_io tcp",
        start=modbus_io.start,
        backing=scripted.ScriptedLights,
        driver="modbus:lights",
        is_true=true_lights,
        far_options={"transport": "tcp"},
    ),
    Bench(
        name="modbus_io rtu",
        start=modbus_io.start,
        backing=scripted.ScriptedLights,
        driver="modbus:lights",
        is_true=true_lights,
        far_options={"transport": "rtu"},
    ),
    Bench(
        name="netft",
        start=netft.start,
        backing=TimedForceTorque,
        driver="udp:netft",
        is_true=true_wrench,
        taken_s=taken_s,
        stamps="taken",
    ),
    Bench(
        name="bota",
        start=bota.start,
        backing=TimedForceTorque,
        driver="serial:bota",
        taken_s=taken_s,
        is_true=true_wrench,
    ),
    Bench(
        name="scip serial",
        start=scip.start,
        backing=scripted.ScriptedScanner,
        driver="scip:scanner",
        is_true=true_scan(scip_angles),
        far_options={**FAST_SCAN, "transport": "serial"},
    ),
    Bench(
        name="scip tcp",
        start=scip.start,
        backing=scripted.ScriptedScanner,
        driver="scip:scanner",
        is_true=true_scan(scip_angles),
        far_options=FAST_SCAN,
    ),
    Bench(
        name="lms200",
        start=lms200.start,
        backing=scripted.ScriptedScanner,
        driver="serial:lms200",
        is_true=true_scan(sick_angles),
    ),
    Bench(
        name="rplidar",
        start=rplidar.start,
        backing=scripted.ScriptedScanner,
        driver="serial:rplidar",
        is_true=true_scan(turn_angles),
        options={"scan_rate_hz": 20.0},
        far_options={"scan_rate_hz": 40.0},
        faults=WITHOUT_CRC,
    ),
    Bench(
        name="rplidar express",
        start=rplidar.start,
        backing=scripted.ScriptedScanner,
        driver="serial:rplidar",
        is_true=true_express,
        options={"scan_rate_hz": 20.0, "mode": "express"},
        far_options={"scan_rate_hz": 40.0, "nodes": 384},
    ),
    Bench(
        name="ur",
        start=ur.start,
        backing=MovingArm,
        driver="ur:rtde",
        taken_s=taken_s,
        is_true=true_joints,
        options={"rate_hz": 125.0},
        stamps="taken",
    ),
    *ROS2_BENCHES,
    *CAMERA_BENCHES,
    *GIGE_BENCHES,
    *LOCAL_BENCHES,
    Bench(
        name="cia402",
        start=cia402.start,
        backing=MovingArm,
        driver="can:cia402",
        taken_s=taken_s,
        is_true=true_joints,
        stamps="taken",
    ),
    Bench(
        name="cia402 virtual",
        start=cia402.start,
        backing=MovingArm,
        driver="can:cia402",
        taken_s=taken_s,
        is_true=true_joints,
        far_options={"transport": "virtual"},
        stamps="taken",
    ),
    Bench(
        name="dynamixel",
        start=dynamixel.start,
        backing=MovingArm,
        driver="serial:dynamixel",
        taken_s=taken_s,
        is_true=true_joints,
    ),
    Bench(
        name="modbus_io touch",
        start=modbus_io.start,
        backing=TimedTouch,
        driver="modbus:touch",
        is_true=true_contacts,
        far_options={"transport": "tcp"},
    ),
    Bench(
        name="modbus_io switch",
        start=modbus_io.start,
        backing=lambda: scripted.ScriptedProximity(fixed_m=0.01),
        driver="modbus:proximity",
        is_true=is_near,
        far_options={"transport": "rtu"},
    ),
    Bench(
        name="ur lights",
        start=ur_io.start,
        backing=scripted.ScriptedLights,
        driver="ur:lights",
        is_true=true_lights,
    ),
    Bench(
        name="ur touch",
        start=ur_io.start,
        backing=TimedTouch,
        driver="ur:touch",
        is_true=true_contacts,
    ),
    Bench(
        name="dynamixel gripper",
        start=dynamixel_gripper.start,
        backing=lambda: scripted.ScriptedGripper(object_m=0.04),
        driver="serial:dynamixel_gripper",
        is_true=true_width,
    ),
)


@contextmanager
def running(bench: Bench, far_options: dict[str, Any]) -> Iterator[tuple[Any, Any, Any]]:
    """Yield the driver, the emulator and its backing device."""
    backing = bench.backing()
    far_side = bench.start(backing, {**bench.far_options, **far_options})
    device = None
    try:
        context = Context(name="dut")
        if bench.make is not None:
            device = bench.make(context, far_side)
        else:
            device = connect(context, bench.driver, {**far_side.address, **bench.options})
        yield device, far_side, backing
    finally:
        if device is not None:
            device.close()
        far_side.close()


def bench(name: str) -> Bench:
    """Return the test setup called `name`."""
    return next(item for item in BENCHES if item.name == name)
