"""Modbus masters over RTU and TCP: pymodbus encodes and decodes; deadlines, framing and the order of answers are ours.

docs/decisions/0007-modbus-timing.md says why, with figures. Only functions 1-4, 15, 16 and 43 are sent: on a two-wire
bus with echo, the echo of a request with function 5 or 6 is identical to its acknowledgement.
"""

from __future__ import annotations

import contextlib
import struct
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from drivers.transport.checks import crc_modbus
from drivers.transport.link import Link, NoAnswer, Refused, drain, drain_until_quiet, now_s

if TYPE_CHECKING:
    from pymodbus.pdu import ModbusPDU

    from drivers.transport.modbus_pdu import Question

READ_COILS, READ_INPUTS, READ_HOLDING, READ_INPUT_REGISTERS = 1, 2, 3, 4
WRITE_COILS, WRITE_REGISTERS = 15, 16
IDENTIFY = 43
VENDOR, PRODUCT, REVISION = 0, 1, 2
EXCEPTIONS = {
    1: "function not known",
    2: "no such address",
    3: "value refused",
    4: "device failure",
    5: "accepted, still working",
    6: "device busy",
    10: "gateway has no path to the device",
    11: "device behind the gateway does not answer",
}
BUSY = (5, 6)
BUSY_REST_S = 0.01
HINTS = {
    1: "the device lacks a function that the driver needs: is it the right device?",
    2: "the device has fewer points, or other registers, than its options say",
    3: "the device has fewer points, or other registers, than its options say",
    4: "the device reports a failure of its own: check its display and its manual",
    10: "check the unit number, and the wiring behind the gateway",
    11: "check the unit number, and the wiring behind the gateway",
}
FIRST_PROBES = (IDENTIFY, READ_HOLDING)
PROBES = (READ_HOLDING, READ_INPUT_REGISTERS, READ_INPUTS, READ_COILS)  # some devices have registers only
RARE_COUNT = 11  # no driver reads as many registers, or as many bytes of inputs
RTU_GAP_S = 0.00175  # 3.5 characters above 19200 baud (Modbus over serial line V1.02, 2.5.1.1)


class Busy(NoAnswer):
    """The device asks for more time (exception 5 or 6)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What a device says of itself (function 43, type 14)."""

    vendor: str
    product: str
    revision: str

    def __str__(self) -> str:
        return " ".join(text for text in (self.vendor, self.product, self.revision) if text)


class ModbusMaster(ABC):
    """Base of the Modbus masters: sends requests and reads answers; the caller gives units and addresses.

    Args:
        timeout_s: time limit for one answer.
    """

    def __init__(self, link: Link, *, timeout_s: float) -> None:
        from drivers.transport import modbus_pdu

        self._pdus = modbus_pdu
        self._link = link
        self._timeout_s = timeout_s
        self._identities: dict[int, Identity | None] = {}
        self.late_bytes = 0
        self.asked_s = 0.0  # when the last request was sent

    def read_bits(
        self, *, unit: int, address: int, count: int, until_s: float, function: int = READ_INPUTS
    ) -> tuple[bool, ...]:
        """Read `count` coils (function 1) or discrete inputs (2)."""
        answer = self._ask(unit, self._pdus.read_bits(function, address, count), until_s)
        return tuple(answer.bits[:count])

    def read_registers(
        self, *, unit: int, address: int, count: int, until_s: float, function: int = READ_HOLDING
    ) -> tuple[int, ...]:
        """Read `count` holding (function 3) or input (4) registers, unsigned."""
        return tuple(self._ask(unit, self._pdus.read_registers(function, address, count), until_s).registers)

    def meet(self, unit: int) -> None:  # noqa: B027  # TCP needs no probe
        """Send no probe before the next request: its answer has a form that nothing else is asked for in.

        The device answers in order, so that whatever follows that answer is new.
        """

    def write_coils(self, *, unit: int, address: int, values: Sequence[bool], until_s: float) -> None:
        """Write consecutive coils (function 15)."""
        self._ask(unit, self._pdus.write_bits(address, values), until_s)

    def write_registers(self, *, unit: int, address: int, values: Sequence[int], until_s: float) -> None:
        """Write consecutive holding registers (function 16)."""
        self._ask(unit, self._pdus.write_registers(address, values), until_s)

    def identity(self, unit: int, until_s: float) -> Identity | None:
        """Return vendor, product and revision, which the device is asked for until it has answered; None if it does not.

        Raises:
            LinkLost: the port is gone.
        """
        if unit not in self._identities:
            with contextlib.suppress(NoAnswer):
                self._identify(unit, until_s, self._ask)
        return self._identities.get(unit)

    def _identify(self, unit: int, until_s: float, ask: Callable[[int, Question, float], ModbusPDU]) -> None:
        try:
            answer = ask(unit, self._pdus.read_identity(), until_s)
        except Refused:
            self._identities[unit] = None
            return
        texts, following = self._pdus.identity_objects(answer)
        while following > max(texts, default=REVISION):
            more, following = self._pdus.identity_objects(self._ask(unit, self._pdus.read_identity(following), until_s))
            texts |= more
        self._identities[unit] = Identity(*(texts.get(number, "") for number in (VENDOR, PRODUCT, REVISION)))

    def _ask(self, unit: int, question: Question, until_s: float) -> ModbusPDU:
        """Return the answer; ask again after a lost one while time remains.

        Each exchange is repeated on its own, so that a task of several exchanges does not restart with every lost frame.

        Raises:
            NoAnswer: no matching answer came in time, or the device stayed busy.
            Refused: the device answered with an exception.
            LinkLost: the port is gone.
        """
        while True:
            try:
                return self._exchange(unit, question, until_s)
            except NoAnswer as error:
                left_s = until_s - now_s()
                if left_s < (self.attempt_s if isinstance(error, Busy) else 0.5 * self._timeout_s):
                    raise  # do not ask a busy device again while other callers wait for the bus
                if isinstance(error, Busy):
                    self._link.read(now_s() + BUSY_REST_S)

    @property
    def attempt_s(self) -> float:
        """Return the time that a poll should allow per attempt, including clearing the line beforehand, in seconds."""
        return self._timeout_s

    def _listen(self, unit: int, question: Question, until_s: float) -> ModbusPDU:
        buffer, answer_until_s = b"", self._answer_until(until_s)
        while chunk := self._link.read(answer_until_s):
            buffer += chunk
            found = self._find(buffer, unit, question)
            if found:
                answer = self._pdus.decode(question, found)
                if answer.isError():
                    raise exception(unit, question.function, answer.exception_code)
                return answer
        raise self._silence(buffer, unit)

    @abstractmethod
    def _find(self, buffer: bytes, unit: int, question: Question) -> bytes:
        """Return the answer's PDU, or nothing while it has not arrived whole."""

    def _answer_until(self, until_s: float) -> float:
        return min(until_s, now_s() + self._timeout_s)

    @abstractmethod
    def _exchange(self, unit: int, question: Question, until_s: float) -> ModbusPDU: ...

    def _silence(self, buffer: bytes, unit: int) -> NoAnswer:
        got = f"{len(buffer)} bytes that do not fit: {buffer[:16].hex(' ')}" if buffer else "not one byte"
        late = f"; bytes that came later than `timeout_s` = {self._timeout_s:g} s: {self.late_bytes}"
        return NoAnswer(f"{self._link.name}, unit {unit}: no answer, {got}{late if self.late_bytes else ''}")


def exception(unit: int, function: int, code: int) -> Refused | Busy:
    """Return the error for a Modbus exception code."""
    text = EXCEPTIONS.get(code, "not in the standard")
    what = f"unit {unit} reports exception {code} ({text}) to function {function & 0x7F}"
    if code in BUSY:
        return Busy(what)
    return Refused(what, code=code, hint=HINTS.get(code, "look the code up in the device's manual"))


class ModbusTcp(ModbusMaster):
    """Modbus TCP: the transaction id identifies each answer, so a late one is never taken for the next."""

    def __init__(self, link: Link, *, timeout_s: float) -> None:
        super().__init__(link, timeout_s=timeout_s)
        self._tid = 0

    def _exchange(self, unit: int, question: Question, until_s: float) -> ModbusPDU:
        self._tid = self._tid % 0xFFFF + 1
        self.late_bytes += len(drain(self._link))
        self.asked_s = now_s()
        self._link.write(
            struct.pack(">HHHB", self._tid, 0, len(question.request) + 1, unit) + question.request, until_s
        )
        return self._listen(unit, question, until_s)

    def _find(self, buffer: bytes, unit: int, question: Question) -> bytes:
        start = struct.pack(">HH", self._tid, 0)
        at = buffer.find(start)
        while at >= 0:
            size = int.from_bytes(buffer[at + 4 : at + 6], "big")
            frame = buffer[at + 6 : at + 6 + size]
            for head, kind in question.forms:
                # pymodbus gives the length of an RTU frame with this content, which ends with two more bytes.
                is_like_it = len(frame) == size and frame.startswith(bytes([unit]) + head)
                if is_like_it and kind.calculateRtuFrameSize(frame) == size + 2:
                    return frame[1:]
            at = buffer.find(start, at + 1)
        return b""


class ModbusRtu(ModbusMaster):
    """Modbus RTU master.

    RTU has no transaction id. After a time-out, no request like the lost one is sent until the line is known to be
    clear: late bytes are drained, and if the next request could accept the lost answer, another request is sent first,
    whose answer cannot be confused with it. A device answers in order, so whatever follows that answer is new. The first
    request to a unit is preceded by such a probe too, because an answer to whoever had the port before may still come.

    Args:
        gap_s: silence before each request, in seconds; 0 where the line does not need it.
        quarantine_s: after a time-out, how long to wait for the late answer before asking again.
        is_clear: whether it is certain that nobody had asked anything on this line before.
    """

    def __init__(
        self,
        link: Link,
        *,
        timeout_s: float,
        gap_s: float = RTU_GAP_S,
        quarantine_s: float = 0.1,
        is_clear: bool = False,
    ) -> None:
        super().__init__(link, timeout_s=timeout_s)
        self._gap_s = gap_s
        self._quarantine_s = quarantine_s
        self._is_clear = is_clear
        self._quiet_since_s = 0.0
        self._unanswered: set[tuple[int, int]] = set()  # (unit, function)
        self._own_probe: int | None = None  # unit whose next request needs no probe before it
        self._met: set[int] = set()  # units whose answers are known to be of this session

    @property
    def attempt_s(self) -> float:
        """Return the time of quarantine, probe and the attempt itself, in seconds."""
        return 2.0 * self._timeout_s + self._quarantine_s

    def identity(self, unit: int, until_s: float) -> Identity | None:
        """Return vendor, product and revision; the probe before the first request asks for them."""
        if unit in self._met or self._is_clear:
            return super().identity(unit, until_s)
        with contextlib.suppress(NoAnswer):
            self._clean(unit, self._pdus.read_identity(), until_s)
        return self._identities.get(unit)

    def _exchange(self, unit: int, question: Question, until_s: float) -> ModbusPDU:
        is_probe, self._own_probe = self._own_probe == unit, None
        if self._unanswered or not (self._is_clear or is_probe or unit in self._met):
            self._clean(unit, question, until_s)
        return self._transact(unit, question, until_s)

    def _clean(self, unit: int, question: Question, until_s: float) -> None:
        """Wait out the quarantine, then send a probe whose answer cannot be confused with a lost one."""
        end_s = min(self.asked_s + self._timeout_s + self._quarantine_s, until_s)
        while self._unanswered and now_s() < end_s:
            late = self._link.read(end_s)
            self.late_bytes += len(late)
            if len(late) >= 5:  # the late answer itself: the line is clear now
                break
        is_met = self._is_clear or unit in self._met
        if is_met and (unit, question.function) not in self._unanswered:
            return
        for other in PROBES if is_met else FIRST_PROBES:
            if (unit, other) not in self._unanswered:
                self._probe(unit, other, until_s)
                return
        self._await_life(unit, question, until_s)

    def _await_life(self, unit: int, question: Question, until_s: float) -> None:
        """Wait for a sign of life when every probe has remained unanswered.

        The device is off, or knows no other function, or is so slow that any of those answers may still arrive. Ask
        once, take any answer only as a sign of life, and wait until the device has sent the rest.

        Raises:
            NoAnswer: nothing was heard.
        """
        frame = self._send(unit, question, until_s)
        heard, answer_until_s = b"", self._answer_until(until_s)
        while not heard.removeprefix(frame) and (chunk := self._link.read(answer_until_s)):
            heard += chunk
        heard = heard.removeprefix(frame)
        self.late_bytes += len(heard)
        if not heard:
            raise self._silence(b"", unit)
        self.late_bytes += drain_until_quiet(self._link, quiet_s=self._timeout_s, until_s=until_s)
        if now_s() >= until_s:
            late = (
                f"late answers to earlier requests still arrive; `timeout_s` = {self._timeout_s:g} s may be too short"
            )
            raise NoAnswer(f"{self._link.name}, unit {unit}: {late}")
        self._heard(unit)

    def _probe(self, unit: int, function: int, until_s: float) -> None:
        with contextlib.suppress(Refused, Busy):  # an exception is an answer too
            if function == IDENTIFY:
                self._identify(unit, until_s, self._transact)
            elif function >= READ_HOLDING:
                self._transact(unit, self._pdus.read_registers(function, 0, RARE_COUNT), until_s)
            else:
                self._transact(unit, self._pdus.read_bits(function, 0, 8 * RARE_COUNT), until_s)

    def _transact(self, unit: int, question: Question, until_s: float) -> ModbusPDU:
        self._wait_for_gap()
        self.late_bytes += len(drain(self._link))
        self._send(unit, question, until_s)
        self._unanswered.add((unit, question.function))
        return self._listen(unit, question, until_s)

    def _send(self, unit: int, question: Question, until_s: float) -> bytes:
        frame = bytes([unit]) + question.request
        frame += struct.pack("<H", crc_modbus(frame))
        self.asked_s = now_s()
        self._link.write(frame, until_s)
        return frame

    def _wait_for_gap(self) -> None:
        while (wait_s := self._quiet_since_s + self._gap_s - now_s()) > 0.0:
            if late := self._link.read(now_s() + wait_s):
                self.late_bytes += len(late)
                self._quiet_since_s = now_s()

    def _find(self, buffer: bytes, unit: int, question: Question) -> bytes:
        for head, kind in question.forms:
            start = bytes([unit]) + head
            at = buffer.find(start)
            while at >= 0:
                size = kind.calculateRtuFrameSize(buffer[at:])
                frame = buffer[at : at + size]
                if len(frame) == size > 2 and crc_modbus(frame[:-2]) == frame[-2] | frame[-1] << 8:
                    self._quiet_since_s = now_s()
                    self._heard(unit)
                    return frame[1:-2]
                at = buffer.find(start, at + 1)
        return b""

    def meet(self, unit: int) -> None:
        """Send no probe before the next request to this unit, if it is the first of the session."""
        self._own_probe = unit

    def _heard(self, unit: int) -> None:
        """Record that whatever this unit sends from now on answers a later request."""
        self._met.add(unit)
        self._unanswered = {lost for lost in self._unanswered if lost[0] != unit}
