"""Templates of a new driver: driver, emulator, conformance test, page; `drivers.scaffold` fills in the `$words`."""

from __future__ import annotations

from string import Template

DRIVER = Template('''"""Driver of $title: say what it measures, over which wire, and which manual describes its protocol."""

from __future__ import annotations

$imports

HEADER = b"\\xa5\\x5a"
FRAME = struct.Struct("<2sB${count}${code}B")
RATE_HZ = $rate_hz
$constants

class ${cls}Options($options_base):
    """Options of `$transport:$name`; add keys as the device needs them."""


def framer() -> Framer:
    """`A5 5A counter values sum`."""
    return Framer(HEADER, FRAME.size, lambda frame: sum_low_byte(frame[:-1]) == frame[-1])


class $cls($base):
    """Driver of $title."""

$members
    def __init__(self, context: Context, options: ${cls}Options) -> None:
        opener, link_name = $opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=link_name, max_age_s=3.0 / RATE_HZ)
        self._framer = framer()
        self._times = FrameTimes(period_s=1.0 / RATE_HZ, frame_bytes=FRAME.size)
        self._counter: int | None = None

${methods}    def start(self, link: Link) -> None:
        """Bring the device from any state to streaming: stop, identify, configure, start. This one needs none of it."""
        drain(link)
        self._framer.reset()
        self._times.reset()
        self._counter = None

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish each complete frame; its counter shows which frames were lost or repeated."""
        for frame, valid_s in self._times.stamped(self._framer.feed(chunk), arrived_s=arrived_s, byte_s=self.byte_s):
            _, counter, *numbers, _ = FRAME.unpack(frame)
            gap = 1 if self._counter is None else (counter - self._counter) % 256
            if gap == 0:
                continue
            self._counter = counter
            value = $decode
            self.$publish(value, valid_s=valid_s, missed=gap - 1)


@takes(${cls}Options)
def connect(context: Context, options: dict[str, Any]) -> $cls:
    """Entry point `$transport:$name`."""
    device = $cls(context, read_options(context, options, ${cls}Options))
    device.join()
    return device
''')

EMULATOR = Template('''"""Emulator of $title, backed by any device of kind $kind."""

from __future__ import annotations

$far_imports


class ${cls}Emulator(WireEmulator):
    """Running emulator at the other end of the driver's link."""

    period_s = 1.0 / RATE_HZ

    def __init__(self, backing: $protocol, options: FaultOptions) -> None:
        super().__init__($port_made, options, name="$name")
        self._backing = backing
        self._counter = 0
$far_methods
    def on_tick(self) -> None:
        """Send one frame with the newest sample of the backing device."""
        sample = self._backing.$read(deadline=self.deadline())
        values = $encode
        numbers = [round(1000.0 * value) for value in values]
        self._counter = (self._counter + 1) % 256
        body = FRAME.pack(HEADER, self._counter, *numbers, 0)[:-1]
        self.send(None, body + bytes([sum_low_byte(body)]))


def start(backing: Device, options: dict[str, Any]) -> ${cls}Emulator:
    """Entry point `$name` in the group `panelwright.emulators`."""
    if not isinstance(backing, $protocol):
        raise Unsupported(
            f"the emulator of $title cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind $kind as the emulator's backing device",
        )
    emulator = ${cls}Emulator(backing, validate(options, FaultOptions, source="emulators.$name"))
    emulator.begin()
    return emulator
''')

TEST = Template('''"""$cls keeps the promises of its kind, over a whole wire and over a damaged one."""

$test_imports

CLOCK = WallClock()


class Test$cls($contract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[Any]]:
        far_side = start($stand_in(), {})
        device = connect(Context(name="$name"), far_side.address)
        yield Rig(device=device, clock=CLOCK, sample_period_s=2.5 / $rate_hz, inject=far_side.inject)
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

PAGE = Template("""# $transport:$name: $title

What it is, the document that the driver was written from, what it does not do.

| key | meaning | default |
| --- | --- | --- |
| | those of `drivers.transport.options.$options_base` | |

Frames: `A5 5A counter values.. sum`, $count values in thousandths of the SI unit, $rate_hz a second.
""")

README = Template("""
```
pip install --no-deps -e .      # beside panelwright, in its environment
pytest
```

A cell file then says

```toml
[devices.some_name]
kind = "$kind"
driver = "$transport:$name"
```
""")

PROJECT = Template("""[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "$project"
version = "0.1"
description = "A $kind driver for panelwright"
requires-python = "==3.11.*"
dependencies = ["panelwright"]

[project.entry-points."panelwright.devices"]
"$transport:$name" = "$driver:connect"

[project.entry-points."panelwright.emulators"]
$name = "$far_side:start"

[tool.setuptools]
packages = ["$package"]

[tool.pytest.ini_options]
testpaths = ["tests"]
pythonpath = ["."]
markers = ["conformance(level): a promise of a device kind"]
""")
