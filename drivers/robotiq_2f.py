"""Robotiq 2F-85, 2F-140 and Hand-E grippers over Modbus RTU (2F-85/140 manual, pp 58-60).

Activation moves the jaws, so it happens once, when the driver connects; if the gripper loses its activation later,
the driver reports that and waits to be connected again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from drivers.kinds.grippers import require_finite, require_stroke
from drivers.transport.link import Refused, now_s
from drivers.transport.modbus import READ_HOLDING, READ_INPUT_REGISTERS, ModbusMaster
from drivers.transport.modbus_bus import ModbusDevice, ModbusOptions
from drivers.transport.options import read_options
from hal.clock import Deadline
from hal.devices import DeviceKind, GripperCapabilities, GripperState
from hal.errors import CellError, DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

OUTPUT, INPUT = 0x03E8, 0x07D0
ACTIVATE, GO_TO = 0x01, 0x08
READY = 3
OPENED_ON, CLOSED_ON = 1, 2
ACTIVATION_PENDING = 5
FAULTS = {
    7: "not activated",
    8: "too hot",
    9: "no request from the host for 1 s",
    10: "supply voltage too low",
    11: "automatic release under way",
    12: "internal fault",
    13: "activation failed",
    14: "too much current",
    15: "automatic release done",
}
PASSING_FAULTS = (7, 9)  # cleared by activation or the next command: no reason to refuse the connection
VALID = (Quality.VALID, Cause.NONE)


class GripperOptions(ModbusOptions):
    """Options of `modbus:robotiq_2f`; the counts at the ends of the stroke differ from gripper to gripper."""

    unit: Annotated[int, Field(ge=1, le=247)] = 9
    stroke_m: Annotated[float, Field(gt=0, le=0.2, description="width between the jaws when open; measure it")] = 0.085
    open_count: Annotated[int, Field(ge=0, le=255, description="position count when fully open; measure it")] = 3
    closed_count: Annotated[int, Field(ge=1, le=255, description="position count when fully closed; measure it")] = 230
    min_force_n: Annotated[float, Field(ge=0, description="grip force at the force value 0")] = 20.0
    max_force_n: Annotated[float, Field(gt=0, description="grip force at the force value 255")] = 235.0
    min_speed_m_per_s: Annotated[float, Field(ge=0, description="speed of the jaws at the speed value 0")] = 0.02
    max_speed_m_per_s: Annotated[float, Field(gt=0, description="speed of the jaws at the speed value 255")] = 0.15
    activate: Annotated[bool, Field(description="whether connecting activates the gripper, which moves its jaws")] = (
        True
    )
    activation_s: Annotated[float, Field(gt=0, le=30, description="longest wait for the activation")] = 8.0

    @model_validator(mode="after")
    def _has_ranges(self) -> Self:
        require_stroke(self.open_count, self.closed_count)
        if self.min_force_n >= self.max_force_n or self.min_speed_m_per_s >= self.max_speed_m_per_s:
            raise ValueError("min_force_n and min_speed_m_per_s must be below max_force_n and max_speed_m_per_s")
        return self


@dataclass(frozen=True, slots=True, kw_only=True)
class Status:
    """Contents of registers 07D0-07D2."""

    is_activated: bool
    goes_to: bool
    state: int
    object: int
    fault: int
    echo: int
    position: int
    current_ma: int


def decode_status(words: tuple[int, ...]) -> Status:
    """Decode gACT, gGTO, gSTA, gOBJ | 0 | 0, gFLT | gPR | gPO | gCU from three registers."""
    s = words[0] >> 8
    return Status(
        is_activated=bool(s & 1),
        goes_to=bool(s >> 3 & 1),
        state=s >> 4 & 3,
        object=s >> 6 & 3,
        fault=words[1] >> 8 & 0x0F,
        echo=words[1] & 0xFF,
        position=words[2] >> 8,
        current_ma=10 * (words[2] & 0xFF),
    )


def encode_command(*, action: int, position: int = 0, speed: int = 0, force: int = 0) -> tuple[int, int, int]:
    """Encode rACT, rGTO | 0 | 0 | rPR | rSP | rFR as three registers."""
    return action << 8, position, speed << 8 | force


class Robotiq2F(ModbusDevice[GripperState]):
    """Robotiq two-finger gripper."""

    kind = DeviceKind.GRIPPER

    def __init__(self, context: Context, options: GripperOptions) -> None:
        super().__init__(context, options)
        self._options = options
        self._goal: int | None = None
        self._force_n = 0.0
        self._function: int | None = None

    def capabilities(self) -> GripperCapabilities:
        """Return the capabilities given by the options."""
        o = self._options
        return GripperCapabilities(
            min_width_m=0.0, max_width_m=o.stroke_m, max_force_n=o.max_force_n, max_speed_m_per_s=o.max_speed_m_per_s
        )

    def read_state(self, *, deadline: Deadline) -> Stamped[GripperState]:
        """Return the newest width and grip.

        While it holds, the force is the commanded one, as the gripper measures none.
        """
        return self.newest(deadline)

    def command(self, *, width_m: float, force_n: float, speed_m_per_s: float, deadline: Deadline) -> float:
        """Start a motion; return the width of the nearest count, in metres."""
        o = self._options
        require_finite(self.name, width_m, force_n, speed_m_per_s)
        goal = self._count(min(max(width_m, 0.0), o.stroke_m))
        force = _part(force_n, o.min_force_n, o.max_force_n)
        speed = _part(speed_m_per_s, o.min_speed_m_per_s, o.max_speed_m_per_s)
        words = encode_command(action=ACTIVATE | GO_TO, position=goal, speed=speed, force=force)

        def work(client: ModbusMaster, until_s: float) -> None:
            self._require_ready(self._status(client, until_s))
            client.write_registers(unit=o.unit, address=OUTPUT, values=words, until_s=until_s)

        self.call(work, deadline)
        self._goal = goal
        self._force_n = o.min_force_n + force / 255.0 * (o.max_force_n - o.min_force_n)
        return self._width_m(goal)

    def activate(self) -> None:
        """Clear and set rACT unless the gripper is active, then wait until the jaws have found their end positions.

        Each exchange is repeated on its own until it succeeds, so a bad line only makes it slower.

        Raises:
            DeviceFault, DeviceTimeout, DeviceUnavailable: not active within `activation_s`.
        """
        until_s = now_s() + self.patience * self._options.activation_s
        actions: list[int] | None = None
        last: CellError | None = None
        while now_s() < until_s:
            try:
                if actions:
                    self._act(actions[0])
                    actions = actions[1:]
                elif self.call(self._status, self._soon()).state == READY:
                    self.mailbox.clear()  # discard values from before the activation
                    return
                elif actions is None:
                    actions = [0, ACTIVATE]
                else:
                    self.bus.rest(self.period_s)
            except (DeviceTimeout, DeviceUnavailable, DeviceFault) as error:
                last = error
                self.bus.rest(self.period_s)
        raise self._inactive() if last is None else last

    def _act(self, action: int) -> None:
        words, unit = encode_command(action=action), self._options.unit
        self.call(
            lambda client, until_s: client.write_registers(unit=unit, address=OUTPUT, values=words, until_s=until_s),
            self._soon(),
        )

    def _soon(self) -> Deadline:
        return Deadline.after(self.context.clock, 6 * self._options.timeout_s)

    def prepare(self, client: ModbusMaster) -> None:
        """Read by the other of two functions than before the loss of the bus, so that no late answer fits; move nothing."""
        if self._function is not None:
            client.meet(self._options.unit)
        self._function = READ_INPUT_REGISTERS if self._function == READ_HOLDING else READ_HOLDING

    def take_reading(self, client: ModbusMaster) -> None:
        """Read three registers and publish width and grip."""
        status = self._status(client, now_s() + client.attempt_s)
        if status.fault > ACTIVATION_PENDING and status.fault not in PASSING_FAULTS:
            text = FAULTS.get(status.fault, "fault not in the manual")
            raise Refused(f"gripper fault {status.fault:X}h: {text}", code=status.fault)
        is_known = (
            status.state == READY and status.fault not in PASSING_FAULTS
        )  # before activation the position count has no reference
        quality, cause = VALID if is_known else (Quality.INVALID, Cause.DEVICE)
        is_current = self._goal is None or status.echo == self._goal
        is_holding = is_current and status.object in (OPENED_ON, CLOSED_ON)
        self.publish(
            GripperState(
                width_m=self._width_m(status.position),
                force_n=self._force_n if is_holding else 0.0,
                is_moving=status.goes_to and (status.object == 0 or not is_current),
                is_holding=is_holding,
            ),
            valid_s=self.exchanges.taken_s(client.asked_s, now_s()),
            quality=quality,
            cause=cause,
        )

    def _status(self, client: ModbusMaster, until_s: float) -> Status:
        unit, function = self._options.unit, self._function or READ_HOLDING
        return decode_status(
            client.read_registers(unit=unit, address=INPUT, count=3, until_s=until_s, function=function)
        )

    def _require_ready(self, status: Status) -> None:
        if status.state != READY:
            raise self._inactive()

    def _inactive(self) -> DeviceFault:
        return DeviceFault(
            f"{self.name} is not activated",
            hint="connect it again, which activates it and moves its jaws",
            device=self.name,
        )

    def _count(self, width_m: float) -> int:
        o = self._options
        return round(o.closed_count + width_m / o.stroke_m * (o.open_count - o.closed_count))

    def _width_m(self, count: int) -> float:
        o = self._options
        part = (o.closed_count - count) / (o.closed_count - o.open_count)
        return o.stroke_m * min(max(part, 0.0), 1.0)


def _part(value: float, low: float, high: float) -> int:
    return round(255 * min(max((value - low) / (high - low), 0.0), 1.0))


@takes(GripperOptions)
def connect(context: Context, options: dict[str, Any]) -> Robotiq2F:
    """Entry point `modbus:robotiq_2f`; activates the gripper unless told not to."""
    parsed = read_options(context, options, GripperOptions)
    device = Robotiq2F(context, parsed)
    device.join()
    if not parsed.activate:
        return device
    try:
        device.activate()
    except BaseException:
        device.close()
        raise
    return device
