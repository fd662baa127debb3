"""The parts of a generated driver that depend on the device kind."""

from __future__ import annotations

from dataclasses import dataclass, field

from hal.devices import DeviceKind

Imports = dict[str, tuple[str, ...]]
"""Names imported from each module; no names means that the module itself is imported."""

NUMPY: Imports = {"numpy": ()}


@dataclass(frozen=True, slots=True, kw_only=True)
class KindText:
    """Pieces of source code for one device kind.

    Attributes:
        base: class that the driver inherits; `publish` is the method that it calls with a value.
        members: class attributes; `methods`: capabilities, reads and commands.
        count: how many numbers a frame holds, each of the `struct` code `code`, in thousandths of the SI unit.
        decode: converts `numbers` to a value; `encode`: converts `sample.value` to numbers.
        far_methods: the emulator's methods that handle commands.
        imports, far_imports: imports that these pieces need, in the driver and in its emulator.
        stand_in: scripted device that backs the emulator in the tests.
    """

    protocol: str
    contract: str
    read: str
    base: str
    members: str
    methods: str
    count: int
    decode: str
    encode: str
    stand_in: str
    code: str = "i"
    publish: str = "publish"
    rate_hz: float = 50.0
    constants: str = ""
    far_methods: str = ""
    imports: Imports = field(default_factory=dict)
    far_imports: Imports = field(default_factory=dict)


def _sensor(protocol: str, value: str, read: str, capabilities: str) -> str:
    return f'''    def capabilities(self) -> {protocol}Capabilities:
        """Return the figures of the manufacturer's data sheet."""
        return {capabilities}

    def {read}(self, *, deadline: Deadline) -> Stamped[{value}]:
        """Return the newest sample."""
        return self.newest(deadline)

'''


def _kind(kind: DeviceKind) -> str:
    return f"    kind = DeviceKind.{kind.name}\n"


STREAM: Imports = {
    "drivers.transport.stream": ("StreamDevice",),
    "hal.clock": ("Deadline",),
    "hal.readings": ("Stamped",),
}

KINDS: dict[DeviceKind, KindText] = {
    DeviceKind.PROXIMITY: KindText(
        protocol="Proximity",
        contract="ProximityContract",
        read="read_distance_m",
        base="StreamDevice[float]",
        members=_kind(DeviceKind.PROXIMITY),
        methods=_sensor(
            "Proximity",
            "float",
            "read_distance_m",
            "ProximityCapabilities(min_range_m=0.0, max_range_m=4.0, sigma_m=0.001, rate_hz=RATE_HZ)",
        ),
        count=1,
        decode="numbers[0] / 1000.0",
        encode="[sample.value]",
        stand_in="ScriptedProximity",
        imports={**STREAM, "hal.devices": ("DeviceKind", "ProximityCapabilities")},
    ),
    DeviceKind.FORCE_TORQUE: KindText(
        protocol="ForceTorque",
        contract="ForceTorqueContract",
        read="read_wrench",
        base="StreamDevice[Wrench]",
        members=_kind(DeviceKind.FORCE_TORQUE),
        methods=_sensor(
            "ForceTorque",
            "Wrench",
            "read_wrench",
            """ForceTorqueCapabilities(
            force_range_n=300.0, torque_range_nm=30.0, force_sigma_n=0.1, torque_sigma_nm=0.005, rate_hz=RATE_HZ
        )""",
        ),
        count=6,
        decode="Wrench(force_n=np.array(numbers[:3]) / 1000.0, torque_nm=np.array(numbers[3:]) / 1000.0)",
        encode="[*sample.value.force_n, *sample.value.torque_nm]",
        stand_in="ScriptedForceTorque",
        imports={**STREAM, **NUMPY, "hal.devices": ("DeviceKind", "ForceTorqueCapabilities", "Wrench")},
    ),
    DeviceKind.TOUCH: KindText(
        protocol="Touch",
        contract="TouchContract",
        read="read_contacts",
        base="StreamDevice[tuple[bool, ...]]",
        members=_kind(DeviceKind.TOUCH),
        methods=_sensor(
            "Touch",
            "tuple[bool, ...]",
            "read_contacts",
            'TouchCapabilities(channels=("left", "right"), threshold_n=1.0, rate_hz=RATE_HZ)',
        ),
        count=2,
        decode="tuple(number > 0 for number in numbers)",
        encode="[float(contact) for contact in sample.value]",
        stand_in="ScriptedTouch",
        imports={**STREAM, "hal.devices": ("DeviceKind", "TouchCapabilities")},
    ),
    DeviceKind.RANGE_SCANNER: KindText(
        protocol="RangeScanner",
        contract="RangeScannerContract",
        read="read_range",
        base="LineScanner",
        members="    beams = BEAMS\n    sigma_m = 0.01\n",
        methods="",
        count=181,
        code="H",
        decode="np.array([number / 1000.0 if number else np.nan for number in numbers])",
        encode="np.nan_to_num(line_m(sample.value, self._backing.capabilities(), ANGLES_RAD))",
        publish="publish_scan",
        rate_hz=25.0,
        stand_in="ScriptedScanner",
        constants="""STEP_RAD = np.radians(1.0)
BEAMS = Beams(
    count=181, first_rad=-90 * STEP_RAD, step_rad=STEP_RAD, min_range_m=0.05, max_range_m=30.0, scan_s=1.0 / RATE_HZ
)
ANGLES_RAD = BEAMS.first_rad + STEP_RAD * np.arange(BEAMS.count)
""",
        imports={**NUMPY, "drivers.kinds.line_scanners": ("Beams", "LineScanner")},
        far_imports={**NUMPY, "drivers.emulators.beams": ("line_m",), "$driver": ("ANGLES_RAD",)},
    ),
    DeviceKind.LIGHTS: KindText(
        protocol="Lights",
        contract="LightsContract",
        read="read_on",
        base="StreamDevice[tuple[bool, ...]]",
        members=_kind(DeviceKind.LIGHTS),
        methods='''    def capabilities(self) -> LightsCapabilities:
        """Return the figures of the manufacturer's data sheet."""
        return LightsCapabilities(channels=("upper left", "upper right", "lower right", "lower left"), settle_s=0.05)

    def set_on(self, on: Sequence[bool], *, deadline: Deadline) -> tuple[bool, ...]:
        """Send all channels in one command."""
        link = self.port.link
        if len(on) != CHANNELS:
            what = f"{self.name} has {CHANNELS} channels, not {len(on)}"
            raise InvalidRequest(what, hint="give one value per channel")
        self.require_open()
        try:
            if link is None:
                raise LinkLost("the port is being opened")
            link.write(command(on), wall_until(deadline))
        except WireError as error:
            raise self.translate(error) from error
        return tuple(map(bool, on))

    def read_on(self, *, deadline: Deadline) -> Stamped[tuple[bool, ...]]:
        """Return the newest feedback."""
        return self.newest(deadline)

''',
        count=4,
        code="B",
        decode="tuple(number > 0 for number in numbers)",
        encode="[0.001 * on for on in sample.value]",
        stand_in="ScriptedLights",
        constants='''CHANNELS = 4


def command(on: Sequence[bool]) -> bytes:
    """`A5 C0 mask sum`."""
    frame = bytes([0xA5, 0xC0, sum(bool(state) << i for i, state in enumerate(on))])
    return frame + bytes([sum_low_byte(frame)])
''',
        far_methods='''        self._commands = Framer(b"\\xa5\\xc0", 4, lambda frame: sum_low_byte(frame[:-1]) == frame[-1])

    def on_bytes(self, peer: Peer, data: bytes) -> None:  # noqa: ARG002  # whoever sends, commands
        """Switch the lights as each command asks."""
        for frame in self._commands.feed(data):
            on = [bool(frame[2] >> i & 1) for i in range(CHANNELS)]
            self._backing.set_on(on, deadline=self.deadline())
''',
        imports={
            **STREAM,
            "collections.abc": ("Sequence",),
            "drivers.transport.device": ("wall_until",),
            "drivers.transport.link": ("LinkLost", "WireError"),
            "hal.devices": ("DeviceKind", "LightsCapabilities"),
            "hal.errors": ("InvalidRequest",),
        },
        far_imports={
            "drivers.emulators.ports": ("Peer",),
            "drivers.transport.framing": ("Framer",),
            "$driver": ("CHANNELS",),
        },
    ),
}
