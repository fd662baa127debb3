"""Emulated Universal Robots controller on three TCP ports (RTDE, script, dashboard) that moves any arm.

It understands only the URScript that the driver sends: `stopj`, and a program that waits for a heartbeat above the
first one, then servos to the joint positions in RTDE registers, and ends when the heartbeat no longer changes.
"""

from __future__ import annotations

import math
import re
import struct
import time
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.emulators.base import WireEmulator, time_of
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import Peer
from drivers.emulators.ur_ports import UrPorts
from drivers.kinds.arms import kinematics_of
from drivers.ur import rtde
from hal.devices import Arm, Device, JointState
from hal.errors import Unsupported
from hal.strict import validate

OUTPUT_TYPES = {
    "timestamp": "DOUBLE",
    "actual_q": "VECTOR6D",
    "actual_qd": "VECTOR6D",
    "target_q": "VECTOR6D",
    "robot_mode": "INT32",
    "safety_mode": "INT32",
    "runtime_state": "UINT32",
    "speed_scaling": "DOUBLE",
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
}
INPUT_TYPES = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    **{f"input_int_register_{i}": "INT32" for i in range(48)},
}
REGISTER = re.compile(r"read_input_integer_register\((\d+)\)")
RUNNING, NORMAL, PROTECTIVE_STOP = 7, 1, 3
STOPPED, PLAYING = 1, 2
FIRST_BEAT = re.compile(r"first = (\d+)")
FAR_BEATS = re.compile(r"last > first \+ (\d+)")
WAIT_CYCLES = re.compile(r"waited < (\d+):")
SILENT_CYCLES = re.compile(r"while silent < (\d+):")
CYCLE_S = 0.002


PortNumber = Annotated[int, Field(ge=0, le=65535)]  # 0: any free port; a real controller uses 30004, 30002, 29999


class UrEmulatorOptions(FaultOptions):
    """`[emulators.NAME.emulator_options]`"""

    rate_hz: Annotated[float, Field(gt=0, le=500)] = 125.0
    rtde_port: PortNumber = 0
    script_port: PortNumber = 0
    dashboard_port: PortNumber = 0


class UrEmulator(WireEmulator):
    """Running emulator of the controller."""

    def __init__(self, backing: Arm, options: UrEmulatorOptions) -> None:
        self.ports = UrPorts(rtde=options.rtde_port, script=options.script_port, dashboard=options.dashboard_port)
        super().__init__(self.ports, options, name="ur")
        self._backing = backing
        self.period_s = 1.0 / options.rate_hz
        self.robot_mode, self.safety_mode, self.runtime = RUNNING, NORMAL, STOPPED
        self._start_s = time.monotonic()
        self._parsers: dict[Peer, rtde.PackageParser] = {}
        self._outputs: dict[Peer, rtde.Recipe] = {}
        self._inputs: dict[Peer, rtde.Recipe] = {}
        self._streams: set[Peer] = set()
        self._registers = [0] * 48
        self._program: list[int] = []  # register of the heartbeat, then one register per joint
        self._wait: tuple[int, int] | None = None  # heartbeats that begin the motion, while it has not begun
        self._beat: int | None = None
        self._beat_s = self._device_s = 0.0
        self._watchdog_s = self._patience_s = math.inf
        self._scripts: dict[Peer, bytes] = {}

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: host, ports and kinematics."""
        return {**super().address, "kinematics": kinematics_of(self._backing.capabilities())}

    def protective_stop(self) -> None:
        """Act as after a collision: stop the arm and end the program."""
        self.safety_mode = PROTECTIVE_STOP
        self._end_program()

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Handle RTDE packages, scripts or dashboard commands, depending on the peer's port."""
        role, _ = peer
        if role == "rtde":
            if not data:
                self._forget(peer)
            parser = self._parsers.setdefault(peer, rtde.PackageParser())
            for kind, payload in parser.feed(data):
                self._rtde(peer, kind, payload)
        elif role == "script":
            self._scripts[peer] = self._scripts.get(peer, b"") + data
            self._read_scripts(peer)
        elif not data:
            self.reply(peer, b"Connected: Universal Robots Dashboard Server\n")
        else:
            for line in data.decode("ascii", "replace").splitlines():
                self.reply(peer, self._dashboard(line.strip()).encode() + b"\n")

    def _forget(self, peer: Peer) -> None:
        """Forget connections that have ended; `peer` is a new one, whose socket may be that of an old one."""
        gone = {*self._parsers, *self._inputs} - {("rtde", sock) for sock in self.ports.rtde_peers()} | {peer}
        for each in gone:
            self._parsers.pop(each, None)
            self._inputs.pop(each, None)
            self._streams.discard(each)

    def _rtde(self, peer: Peer, kind: str, payload: bytes) -> None:
        match kind:
            case "V":
                self.reply(peer, rtde.package("V", bytes([payload == b"\x00\x02"])))
            case "v":
                self.reply(peer, rtde.package("v", struct.pack(">4I", 5, 11, 0, 0)))
            case "O":
                self._confirm(peer, "O", rtde.split_names(payload[8:]), OUTPUT_TYPES, self._outputs)
            case "I":
                self._confirm(peer, "I", rtde.split_names(payload), INPUT_TYPES, self._inputs)
            case "S" | "P":
                (self._streams.add if kind == "S" else self._streams.discard)(peer)
                self.reply(peer, rtde.package(kind, b"\x01"))
            case "U" if peer in self._inputs and payload[0] == self._inputs[peer].id:
                self._take_inputs(self._inputs[peer].unpack(payload))

    def _confirm(
        self, peer: Peer, kind: str, names: tuple[str, ...], known: dict[str, str], recipes: dict[Peer, rtde.Recipe]
    ) -> None:
        types = [known.get(name, "NOT_FOUND") for name in names]
        if kind == "I":  # an input belongs to the client that asked for it first, until it disconnects
            taken = {name for other in self._inputs if other != peer for name in self._inputs[other].names}
            types = [rtde.IN_USE if name in taken else type_ for name, type_ in zip(names, types, strict=True)]
        if not {"NOT_FOUND", rtde.IN_USE} & set(types):
            recipes[peer] = rtde.recipe(1, names, types)
        self.reply(peer, rtde.package(kind, bytes([1]) + ",".join(types).encode()))

    def _take_inputs(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            if name.startswith("input_int_register_"):
                self._registers[int(name.rsplit("_", 1)[1])] = value
        if self.runtime != PLAYING or not self._program:
            return
        self._follow()

    def _follow(self) -> None:
        """Servo to the registers when the heartbeat has changed and, at first, is one that begins the motion."""
        beat = self._registers[self._program[0]]
        if beat == self._beat or (self._wait is not None and not self._wait[0] < beat <= self._wait[1]):
            return
        self._wait, self._beat, self._beat_s = None, beat, self._device_s
        goal = np.array([self._registers[i] for i in self._program[1:]]) * 1e-6
        self._backing.command_position(goal, deadline=self.deadline())

    def _read_scripts(self, peer: Peer) -> None:
        text = self._scripts[peer].decode("ascii", "replace")
        if text.startswith("def "):
            if "\nend\n" not in text:
                return
            self._scripts[peer] = b""
            first, far, wait, silent = (
                int(found.group(1)) if (found := pattern.search(text)) else None
                for pattern in (FIRST_BEAT, FAR_BEATS, WAIT_CYCLES, SILENT_CYCLES)
            )
            self._wait = None if first is None or far is None else (first, first + far)
            self._patience_s = math.inf if wait is None else wait * CYCLE_S
            self._watchdog_s = math.inf if silent is None else silent * CYCLE_S
            self._start_program([int(number) for number in REGISTER.findall(text)])
        elif text.endswith("\n"):
            self._scripts[peer] = b""
            if "stopj" in text:
                self._end_program()

    def _start_program(self, registers: list[int]) -> None:
        """Start a program that reads `registers`: the first is the heartbeat, the others are the joints in order."""
        joints = [number for number in registers if number != registers[0]] if registers else []
        if len(joints) != len(self._backing.capabilities().links) or self.safety_mode != NORMAL:
            return
        self._program = [registers[0], *joints]
        self._beat, self._beat_s = None if self._wait else self._registers[registers[0]], self._device_s
        self._backing.enable(deadline=self.deadline())
        self.runtime = PLAYING
        self._follow()

    def _end_program(self) -> None:
        self._program, self.runtime = [], STOPPED
        self._backing.stop(deadline=self.deadline())

    def _dashboard(self, line: str) -> str:
        match line:
            case "robotmode":
                return f"Robotmode: {'RUNNING' if self.robot_mode == RUNNING else 'POWER_OFF'}"
            case "safetystatus":
                return f"Safetystatus: {'NORMAL' if self.safety_mode == NORMAL else 'PROTECTIVE_STOP'}"
            case "unlock protective stop":
                self.safety_mode = NORMAL
                return "Protective stop releasing"
            case "power on" | "brake release":
                self.robot_mode = RUNNING
                return "Powering on" if line == "power on" else "Brake releasing"
            case "stop":
                self._end_program()
                return "Stopped"
            case "PolyscopeVersion":
                return "URSoftware 5.11.0.0 (emulator)"
            case _:
                return f"could not understand: '{line}'"

    def on_tick(self) -> None:
        """Check the program's watchdog, then send one data package to each client."""
        sample = self._backing.read_state(deadline=self.deadline())
        self._device_s = time_of(sample)
        limit_s = self._watchdog_s if self._wait is None else self._patience_s
        if self.runtime == PLAYING and self._device_s - self._beat_s > limit_s:
            self._end_program()
        values = self._values(sample.value)
        for peer in list(self._streams):
            self.send(peer, self._data(peer, values), protected=slice(0, 3))

    def status_frame(self) -> bytes | None:
        """Return a data package that reports a protective stop."""
        peer = next(iter(self._streams))
        state = self._backing.read_state(deadline=self.deadline()).value
        return self._data(peer, {**self._values(state), "safety_mode": [PROTECTIVE_STOP]})

    def _values(self, state: JointState) -> dict[str, list[float]]:
        position = [float(q) for q in state.position_rad]
        return {
            "timestamp": [time.monotonic() - self._start_s],
            "actual_q": position,
            "actual_qd": [float(v) for v in state.velocity_rad_per_s],
            "target_q": position,
            "robot_mode": [self.robot_mode],
            "safety_mode": [self.safety_mode],
            "runtime_state": [self.runtime],
            "speed_scaling": [1.0],
            **{f"input_int_register_{i}": [value] for i, value in enumerate(self._registers)},
        }

    def _data(self, peer: Peer, values: dict[str, list[float]]) -> bytes:
        recipe = self._outputs[peer]
        return recipe.pack([number for name in recipe.names for number in values[name]])


def start(backing: Device, options: dict[str, Any]) -> UrEmulator:
    """Start the emulator on an arm (entry point `ur`)."""
    if not isinstance(backing, Arm):
        raise Unsupported(
            f"the emulator of a UR arm cannot be backed by a device of kind {backing.kind}",
            hint="choose a driver of kind arm as the emulator's backing device",
        )
    emulator = UrEmulator(backing, validate(options, UrEmulatorOptions, source="emulators.ur"))
    emulator.begin()
    return emulator
