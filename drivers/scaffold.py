"""A new driver that runs from its first minute: driver, far side, test and page, to be changed as the manual says.

The made-up device streams frames `A5 5A counter values.. sum`, values as 32-bit integers in thousandths of the SI unit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from string import Template
from typing import Literal

from hal.devices import DeviceKind
from hal.errors import ConfigError

Transport = Literal["serial", "tcp"]
NAME = re.compile(r"^[a-z][a-z0-9_]{0,40}$")


@dataclass(frozen=True, slots=True, kw_only=True)
class _Kind:
    """What differs from kind to kind."""

    protocol: str
    contract: str
    read: str
    value: str
    extra_imports: str
    count: int
    decode: str
    encode: str
    capabilities: str
    stand_in: str


_KINDS = {
    DeviceKind.PROXIMITY: _Kind(
        protocol="Proximity",
        contract="ProximityContract",
        read="read_distance_m",
        value="float",
        extra_imports="ProximityCapabilities",
        count=1,
        decode="numbers[0] / 1000.0",
        encode="[sample.value]",
        capabilities="ProximityCapabilities(min_range_m=0.0, max_range_m=4.0, sigma_m=0.001, rate_hz=RATE_HZ)",
        stand_in="ScriptedProximity",
    ),
    DeviceKind.FORCE_TORQUE: _Kind(
        protocol="ForceTorque",
        contract="ForceTorqueContract",
        read="read_wrench",
        value="Wrench",
        extra_imports="ForceTorqueCapabilities, Wrench",
        count=6,
        decode="Wrench(force_n=np.array(numbers[:3]) / 1000.0, torque_nm=np.array(numbers[3:]) / 1000.0)",
        encode="[*sample.value.force_n, *sample.value.torque_nm]",
        capabilities="""ForceTorqueCapabilities(
            force_range_n=300.0, torque_range_nm=30.0, force_sigma_n=0.1, torque_sigma_nm=0.005, rate_hz=RATE_HZ
        )""",
        stand_in="ScriptedForceTorque",
    ),
    DeviceKind.TOUCH: _Kind(
        protocol="Touch",
        contract="TouchContract",
        read="read_contacts",
        value="tuple[bool, ...]",
        extra_imports="TouchCapabilities",
        count=2,
        decode="tuple(number > 0 for number in numbers)",
        encode="[float(contact) for contact in sample.value]",
        capabilities='TouchCapabilities(channels=("left", "right"), threshold_n=1.0, rate_hz=RATE_HZ)',
        stand_in="ScriptedTouch",
    ),
}

_DRIVER = Template('''"""$title: what it measures, over which wire, by which document of its maker."""

from __future__ import annotations

import struct
from typing import Any

$numpy
from drivers.transport.checks import sum_low_byte
from drivers.transport.device import StreamDevice
from drivers.transport.framing import Framer
from drivers.transport.link import Link, drain
from drivers.transport.options import $options_base, $opener, read_options
from hal.clock import Deadline
from hal.devices import $devices
from hal.readings import Stamped
from hal.registry import Context

HEADER = b"\\xa5\\x5a"
FRAME = struct.Struct("<2sB${count}iB")
RATE_HZ = 50.0


class ${cls}Options($options_base):
    """Options of `$transport:$name`; add keys as the device needs them."""


def framer() -> Framer:
    """`A5 5A counter values sum`."""
    return Framer(HEADER, FRAME.size, lambda frame: sum_low_byte(frame[:-1]) == frame[-1])


class $cls(StreamDevice[$value]):
    """The device."""

    kind = DeviceKind.$kind_name

    def __init__(self, context: Context, options: ${cls}Options) -> None:
        opener, link_name = $opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=link_name, max_age_s=3.0 / RATE_HZ)
        self._framer = framer()
        self._counter: int | None = None

    def capabilities(self) -> $capabilities_type:
        """The maker's figures."""
        return $capabilities

    def $read(self, *, deadline: Deadline) -> Stamped[$value]:
        """The newest sample."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Stop, identify, configure, start, as if the device had been left in any state; this one needs none of it."""
        drain(link)
        self._framer.reset()
        self._counter = None

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each whole frame; the counter tells lost and repeated ones."""
        for frame in self._framer.feed(chunk):
            _, counter, *numbers, _ = FRAME.unpack(frame)
            gap = 1 if self._counter is None else (counter - self._counter) % 256
            if gap == 0:
                continue
            self._counter = counter
            value = $decode
            self.publish(value, valid_s=arrived_s - len(frame) * self.byte_s, missed=gap - 1)


def connect(context: Context, options: dict[str, Any]) -> $cls:
    """Entry point `$transport:$name`."""
    device = $cls(context, read_options(context, options, ${cls}Options))
    device.join()
    return device
''')

_EMULATOR = Template('''"""The far side of $title, worked by any $kind device."""

from __future__ import annotations

from typing import Any

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import $port
from drivers.transport.checks import sum_low_byte
from hal.devices import Device, $protocol
from hal.errors import Unsupported
from hal.strict import validate
from $package.$name import FRAME, HEADER, RATE_HZ


class ${cls}Emulator(WireEmulator):
    """The device, running."""

    period_s = 1.0 / RATE_HZ

    def __init__(self, backing: $protocol, options: FaultOptions) -> None:
        super().__init__($port_made, options, name="$name")
        self._backing = backing
        self._counter = 0

    def on_tick(self) -> None:
        """One frame."""
        sample = self._backing.$read(deadline=self.deadline())
        numbers = [round(1000.0 * value) for value in $encode]
        self._counter = (self._counter + 1) % 256
        body = FRAME.pack(HEADER, self._counter, *numbers, 0)[:-1]
        self.send(None, body + bytes([sum_low_byte(body)]))


def start(backing: Device, options: dict[str, Any]) -> ${cls}Emulator:
    """Entry point `$name` in the group `panelwright.emulators`."""
    if not isinstance(backing, $protocol):
        raise Unsupported(f"$name cannot stand for a {backing.kind}", hint="back it with a $kind device")
    emulator = ${cls}Emulator(backing, validate(options, FaultOptions, source="emulators.$name"))
    emulator.begin()
    return emulator
''')

_TEST = Template('''"""$cls keeps the promises of its kind, over a whole wire and over a damaged one."""

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest

from drivers.emulators.scripted import $stand_in
from hal.clock import Deadline, WallClock
from hal.conformance import $contract, Rig
from hal.registry import Context
from $package.$name import connect
from $emulators.$module import start

CLOCK = WallClock()


class Test$cls($contract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = start($stand_in(), {})
        device = connect(Context(name="$name"), far_side.address)
        yield Rig(device=device, clock=CLOCK, sample_period_s=0.05, inject=far_side.inject)
        device.close()
        far_side.close()


@pytest.mark.parametrize("fault", ["crc", "drop", "dup", "split", "garbage"])
def test_a_damaged_wire_still_brings_samples(fault: str) -> None:
    far_side = start($stand_in(), {"fault": fault, "every": 3})
    device = connect(Context(name="$name"), far_side.address)
    try:
        samples = [device.newest(Deadline.after(CLOCK, 1.0), not_before_s=CLOCK.now_s()) for _ in range(5)]
        assert all(b.sequence > a.sequence for a, b in pairwise(samples))
    finally:
        device.close()
        far_side.close()
''')

_PAGE = Template("""### $transport:$name: $title
What it is, the document that the driver was written from, the keys of its options.
Frames: `A5 5A counter values.. sum`.
""")


def new_driver(
    name: str, kind: DeviceKind, *, transport: Transport = "serial", package: str = "drivers", own_package: bool = False
) -> dict[Path, str]:
    """Paths and texts of a driver, its emulator, its test and its page; write them where you like.

    Args:
        name: module name, small letters, digits and underscores.
        package: where the driver will be imported from.
        own_package: a package of its own with the emulator beside the driver, instead of a place in this tree.

    Raises:
        ConfigError: no such name, kind or transport is possible.
    """
    if not NAME.fullmatch(name):
        raise ConfigError(f"{name!r} is no module name", hint="small letters, digits and underscores")
    if kind not in _KINDS:
        known = ", ".join(_KINDS)
        raise ConfigError(
            f"there is no template for a {kind}", hint=f"templates: {known}; for others start from the nearest driver"
        )
    if transport not in ("serial", "tcp"):
        raise ConfigError(f"there is no template for {transport!r}", hint="serial or tcp")
    words = _words(name, _KINDS[kind], kind, transport, package, own_package=own_package)
    emulator = Path(package) / f"{name}_emulator.py" if own_package else Path("drivers/emulators") / f"{name}.py"
    tests = Path("tests") if own_package else Path("tests/drivers")
    return {
        Path(package) / f"{name}.py": _DRIVER.substitute(words).replace("\n\n\nfrom drivers", "\n\nfrom drivers"),
        emulator: _EMULATOR.substitute(words),
        tests / f"test_{name}.py": _TEST.substitute(words),
        Path("docs") / f"driver_{name}.md": _PAGE.substitute(words),
    }


def _words(
    name: str, k: _Kind, kind: DeviceKind, transport: Transport, package: str, *, own_package: bool
) -> dict[str, str]:
    is_serial = transport == "serial"
    devices = sorted({"DeviceKind", *k.extra_imports.split(", ")})
    return {
        "name": name,
        "cls": "".join(part.capitalize() for part in name.split("_")),
        "title": name.replace("_", " "),
        "kind": str(kind),
        "kind_name": kind.name,
        "transport": transport,
        "package": package,
        "emulators": package if own_package else "drivers.emulators",
        "module": f"{name}_emulator" if own_package else name,
        "protocol": k.protocol,
        "contract": k.contract,
        "read": k.read,
        "value": k.value,
        "count": str(k.count),
        "decode": k.decode,
        "encode": k.encode,
        "capabilities": k.capabilities,
        "capabilities_type": f"{k.protocol}Capabilities",
        "devices": ", ".join(devices),
        "numpy": "import numpy as np\n" if "np." in k.decode else "",
        "stand_in": k.stand_in,
        "options_base": "SerialOptions" if is_serial else "TcpOptions",
        "opener": "serial_opener" if is_serial else "tcp_opener",
        "port": "PtyPort" if is_serial else "TcpPort",
        "port_made": f'PtyPort("{name}")' if is_serial else "TcpPort()",
    }
