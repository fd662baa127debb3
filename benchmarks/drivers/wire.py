"""Measures calls, rates and decoders on a good link."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import serial

from benchmarks.drivers.benches import bench, running
from benchmarks.drivers.report import cpu_rate, deadline, line, percentiles, rate
from drivers.emulators import ft300, rplidar, scip, scripted, tfmini
from drivers.ft300 import stream_framer
from drivers.rplidar.nodes import decode
from drivers.scip import decode_ranges_mm
from drivers.tfmini import data_framer
from drivers.transport.checks import crc_modbus
from drivers.transport.modbus import ModbusRtu
from drivers.transport.serial_link import open_serial


def part_latency(seconds: float) -> None:
    """Compare a register read by the driver's bus with the same bytes over a bare pyserial port, in alternation."""
    far_side = ft300.start(scripted.ScriptedForceTorque(), {})
    request = bytes.fromhex("090400b40006")
    request += crc_modbus(request).to_bytes(2, "little")
    bare_s: list[float] = []
    ours_s: list[float] = []
    end_s = time.monotonic() + seconds
    try:
        while time.monotonic() < end_s:
            port = serial.Serial(far_side.address["port"], 19_200, timeout=1, exclusive=True)
            for _ in range(200):
                started_s = time.perf_counter()
                port.write(request)
                port.read(17)
                bare_s.append(time.perf_counter() - started_s)
            port.close()
            link = open_serial(far_side.address["port"], baud=19_200, device="bench")
            master = ModbusRtu(link, timeout_s=1.0, gap_s=0.0)
            for _ in range(200):
                started_s = time.perf_counter()
                master.read_registers(unit=9, address=180, count=6, until_s=time.monotonic() + 1.0, function=4)
                ours_s.append(time.perf_counter() - started_s)
            link.close()
    finally:
        far_side.close()
    bare, ours = percentiles(bare_s), percentiles(ours_s)
    over = (ours[0] - bare[0], ours[1] - bare[1])
    measured = f"{over[0]:+.0f} / {over[1]:+.0f} us (bare {bare[0]:.0f} / {bare[1]:.0f})"
    line("RTU call over bare pyserial, p50 / p99", "+80 / +300 us", measured, over[0] <= 80 and over[1] <= 300)
    with running(bench("ft300 modbus"), {}) as (device, _, _):
        reads_s = []
        for _ in range(5000):
            started_s = time.perf_counter()
            device.read_wrench(deadline=deadline())
            reads_s.append(time.perf_counter() - started_s)
    p50, p99 = percentiles(reads_s)
    line(
        "driver read from its mailbox, p50 / p99",
        "+80 / +300 us",
        f"{p50:.0f} / {p99:.0f} us",
        p50 <= 80 and p99 <= 300,
    )


def part_rtu(seconds: float) -> None:
    """Compare the reads per second with pymodbus on the same emulator."""
    from pymodbus.client import ModbusSerialClient

    far_side = ft300.start(scripted.ScriptedForceTorque(), {})
    try:
        path = far_side.address["port"]
        client: Any = ModbusSerialClient(path, baudrate=115_200, timeout=1, retries=0)
        client.connect()
        theirs = rate(lambda: client.read_input_registers(180, count=3, device_id=9), seconds)
        client.close()
        link = open_serial(path, baud=115_200, device="bench")
        master = ModbusRtu(link, timeout_s=1.0, gap_s=0.0)
        ours = rate(
            lambda: master.read_registers(unit=9, address=180, count=3, until_s=time.monotonic() + 1.0, function=4),
            seconds,
        )
        link.close()
    finally:
        far_side.close()
    ratio = ours / theirs
    line("RTU reads/s, ratio to pymodbus", "4x", f"{ratio:.1f}x ({ours:.0f} to {theirs:.0f} /s)", ratio >= 4)


def part_decode(seconds: float) -> None:
    """Measure the points and frames decoded per second of CPU time."""
    data = scip.encode_ranges(np.arange(1081) % 4000)
    points = cpu_rate(lambda: decode_ranges_mm(data), seconds) * 1081
    line("SCIP ranges decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    turn = rplidar.encode_turn(np.arange(3600) * 2 * np.pi / 3600, np.full(3600, 1.0))
    nodes = np.frombuffer(turn * 4, np.uint8).reshape(-1, 5)
    points = cpu_rate(lambda: decode(nodes), seconds) * len(nodes)
    line("RPLIDAR measurements decoded, points/s", "20 M", f"{points / 1e6:.0f} M", points >= 20e6)
    frames = b"".join(tfmini.data_frame(i, 500) for i in range(500))
    count = cpu_rate(lambda: data_framer().feed(frames), seconds) * 500
    line("TFmini frames/s (9 bytes, sum)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)
    frames = b"".join(ft300.stream_frame([i, 2, 3, 4, 5, 6]) for i in range(500))
    count = cpu_rate(lambda: stream_framer().feed(frames), seconds) * 500
    line("FT 300 frames/s (16 bytes, CRC)", "100 k", f"{count / 1e3:.0f} k", count >= 100e3)
