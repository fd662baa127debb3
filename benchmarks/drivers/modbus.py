"""Measures Modbus calls over a bare link with the same bytes, in alternation; the far side is in another process."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

from benchmarks.drivers.far_process import far_process
from benchmarks.drivers.report import line, percentiles
from drivers.transport.checks import crc_modbus
from drivers.transport.link import Link
from drivers.transport.modbus import ModbusRtu, ModbusTcp
from drivers.transport.serial_link import open_serial
from drivers.transport.socket_link import open_tcp

RTU, TCP = "ft300 modbus", "modbus_io tcp"
BAUD, UNIT, WRENCH, COUNT, INPUTS = 115_200, 9, 180, 3, 8
RTU_REQUEST = bytes.fromhex("090400b40003")
RTU_REQUEST += crc_modbus(RTU_REQUEST).to_bytes(2, "little")
RTU_ANSWER_BYTES, TCP_ANSWER_BYTES = 11, 10
TCP_REQUEST = bytes.fromhex("000100000006010200000008")
CALLS = 200  # before the next way has its turn
BARE, OURS, PYMODBUS = "bare link", "ours", "pymodbus"
IMPORTED = (
    "import time, drivers.modbus_io as d; s = time.process_time(); import drivers.transport.modbus_pdu;"
    "print(time.process_time() - s)"
)
Way = Callable[[dict[str, Any]], Any]
"""Opens a link to an address, as a context whose value reads once."""


def part_modbus(seconds: float) -> None:
    """Measure time and rate of reads, and what importing pymodbus takes."""
    with far_process(RTU, TCP) as far:
        for name, ways in (("RTU", (bare_rtu, our_rtu, pymodbus_rtu)), ("TCP", (bare_tcp, our_tcp, pymodbus_tcp))):
            took_s = _in_turns(dict(zip((BARE, OURS, PYMODBUS), ways, strict=True)), far.addresses, seconds)
            bare, ours = percentiles(took_s[BARE]), percentiles(took_s[OURS])
            over = (ours[0] - bare[0], ours[1] - bare[1])
            measured = f"{over[0]:+.0f} / {over[1]:+.0f} us (bare {bare[0]:.0f} / {bare[1]:.0f})"
            is_good = over[0] <= 60 and over[1] <= 300
            line(f"Modbus {name} call over the bare link, p50 / p99", "+60 / +300 us", measured, is_good)
            ratio, to_pymodbus = bare[0] / ours[0], percentiles(took_s[PYMODBUS])[0] / ours[0]
            measured = f"{ratio:.2f} ({1e6 / ours[0]:.0f}/s; pymodbus x {to_pymodbus:.1f})"
            line(f"Modbus {name} reads/s by medians, ratio to the bare link", "0.60", measured, ratio >= 0.6)
    import_ms = 1e3 * float(subprocess.check_output([sys.executable, "-c", IMPORTED]))
    line("importing pymodbus when a link opens, CPU time", "150 ms", f"{import_ms:.0f} ms", import_ms <= 150)


def _in_turns(ways: dict[str, Way], addresses: dict[str, Any], seconds: float) -> dict[str, list[float]]:
    took_s: dict[str, list[float]] = {way: [] for way in ways}
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        for way, opened in ways.items():
            with opened(addresses) as read:
                read()  # the first one meets the device
                for _ in range(CALLS):
                    started_s = time.perf_counter()
                    read()
                    took_s[way].append(time.perf_counter() - started_s)
    return took_s


def _exchange(link: Link, request: bytes, size: int) -> None:
    until_s, got = _soon(), b""
    link.write(request, until_s)
    while len(got) < size:
        got += link.read(until_s)


def _soon() -> float:
    return time.monotonic() + 1.0


@contextmanager
def bare_rtu(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Write a request and read as many bytes as its answer has."""
    with closing(open_serial(addresses[RTU]["port"], baud=BAUD, device="bench")) as link:
        yield lambda: _exchange(link, RTU_REQUEST, RTU_ANSWER_BYTES)


@contextmanager
def our_rtu(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Read registers by our master, without the gap that a real line needs."""
    with closing(open_serial(addresses[RTU]["port"], baud=BAUD, device="bench")) as link:
        master = ModbusRtu(link, timeout_s=1.0, gap_s=0.0)
        yield lambda: master.read_registers(unit=UNIT, address=WRENCH, count=COUNT, until_s=_soon(), function=4)


@contextmanager
def pymodbus_rtu(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Read registers by the client of pymodbus."""
    from pymodbus.client import ModbusSerialClient

    with closing(ModbusSerialClient(addresses[RTU]["port"], baudrate=BAUD, timeout=1, retries=0)) as client:
        client.connect()
        yield lambda: client.read_input_registers(WRENCH, count=COUNT, device_id=UNIT)


@contextmanager
def bare_tcp(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Write a request and read as many bytes as its answer has."""
    with closing(open_tcp(**addresses[TCP], timeout_s=1.0, device="bench")) as link:
        yield lambda: _exchange(link, TCP_REQUEST, TCP_ANSWER_BYTES)


@contextmanager
def our_tcp(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Read inputs by our master."""
    with closing(open_tcp(**addresses[TCP], timeout_s=1.0, device="bench")) as link:
        master = ModbusTcp(link, timeout_s=1.0)
        yield lambda: master.read_bits(unit=1, address=0, count=INPUTS, until_s=_soon())


@contextmanager
def pymodbus_tcp(addresses: dict[str, Any]) -> Iterator[Callable[[], Any]]:
    """Read inputs by the client of pymodbus."""
    from pymodbus.client import ModbusTcpClient

    with closing(ModbusTcpClient(addresses[TCP]["host"], port=addresses[TCP]["port"], timeout=1)) as client:
        client.connect()  # type: ignore[no-untyped-call]
        yield lambda: client.read_discrete_inputs(0, count=INPUTS, device_id=1)
