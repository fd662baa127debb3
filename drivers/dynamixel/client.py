"""Host side of a Dynamixel 2.0 bus: sends requests and assigns each status packet to the right request."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from drivers.dynamixel import protocol
from drivers.transport.bus import Bus
from drivers.transport.link import Link, NoAnswer, Refused, drain, drain_until_quiet, now_s
from drivers.transport.options import SerialOptions, serial_opener
from hal.registry import Context
from hal.wires import ResourceClaim

QUARANTINE_S, LONGEST_QUARANTINE_S = 0.1, 0.8  # wait for late answers; doubled with each further loss
DOUBT_S = 1.0  # an answer overtaken by others may arrive this late
HARDWARE_ERROR, STATUS_RETURN = 70, 68
ALWAYS = b"\x02"  # status return level: every instruction is answered
PACKET_BYTES = 10  # header, id, length, instruction, CRC
HARDWARE_BITS = {0: "supply voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}
REBOOT = "remove the cause, then switch the servo's power off and on, because only a reboot clears this error"
PROBES = range(1, 13)  # lengths of a read from address 0, where no servo has gaps
FIRST_PROBES = (12, 11, 9)  # no device reads as many bytes of one servo


@dataclass(frozen=True, slots=True)
class Part:
    """Identifies a status packet by id, length and, for a packet of several servos, their order."""

    id: int
    size: int
    order: tuple[int, ...] = ()

    def fits(self, packet: protocol.Packet) -> bool:
        """Return whether the packet may be this one."""
        if (packet.id, len(packet.parameters)) != (self.id, self.size):
            return False
        return not self.order or tuple(packet.parameters[1 :: self.size // len(self.order)]) == self.order


Shape = tuple[Part, ...]
"""Shape of an answer: the parts of all its packets."""


class BusOptions(SerialOptions):
    """Keys of every device on a Dynamixel bus."""

    baud: Annotated[int, Field(ge=9600, le=4_500_000)] = 1_000_000
    timeout_s: Annotated[float, Field(gt=0, le=1, description="wait for one answer")] = 0.03

    @property
    @abstractmethod
    def servos(self) -> tuple[int, ...]:
        """Return the ids of the device's servos."""

    def claim(self) -> ResourceClaim:
        """Claim the servos on a shared bus."""
        stations = tuple(f"servo {id_}" for id_ in self.servos)
        return ResourceClaim(wire=f"serial {self.port}", bus=f"Dynamixel 2.0 at {self.baud} baud", stations=stations)


class DynamixelClient:
    """Sends requests and checks that each status packet comes from the right servo, with the right size and order.

    A status packet does not say which request it answers, so no request is sent whose answer could be confused with a
    lost one. A block of all servos is requested with the ids in a different order each time. Other requests wait for
    the late answer; if it does not come, a block of a length that no lost answer has is read first: a bus answers in
    order, so whatever follows that answer is new. The first request is preceded by such a probe too, because an answer
    to whoever had the port before may still come. After two lost answers there is a pause, or a slow bus would never
    catch up.

    Args:
        is_clear: whether it is certain that nobody had asked anything on this line before.
    """

    def __init__(self, link: Link, *, timeout_s: float, is_clear: bool = False) -> None:
        self._link = link
        self._is_clear = is_clear
        self._is_probe = False
        self._timeout_s = timeout_s
        self._fast_sizes: set[int] = set()
        self._framer = protocol.framer(self._fast_sizes)
        self._unanswered: list[Shape] = []  # oldest first
        self._overtaken: deque[tuple[float, Shape]] = deque(maxlen=64)  # lost, but later requests were answered
        self._lost_in_a_row = 0
        self._why = ""
        self._turn = 0
        self.asked_s = 0.0  # when the last request was sent

    def meet(self) -> None:
        """Send no probe before the next request: its answer has a form that is asked for at a session's start only."""
        self._is_probe = True

    def read(self, id_: int, address: int, length: int, until_s: float) -> bytes:
        """Read a block of one servo."""
        return self._ask(protocol.read(id_, address, length), (id_,), length, until_s)[id_]

    def write(self, id_: int, address: int, data: bytes, until_s: float) -> None:
        """Write a block of one servo and wait for the acknowledgement."""
        self._ask(protocol.write(id_, address, data), (id_,), 0, until_s)

    def sync_read(self, ids: tuple[int, ...], address: int, length: int, until_s: float) -> dict[int, bytes]:
        """Read the same block of all servos, one status packet each."""
        return self._ask(protocol.sync_read(address, length, ids), ids, length, until_s)

    def fast_sync_read(self, ids: tuple[int, ...], address: int, length: int, until_s: float) -> dict[int, bytes]:
        """Read the same block of all servos in one status packet."""
        step = length + 4  # error, id, data, and a running CRC
        self._fast_sizes.add(len(ids) * step)

        def request() -> tuple[bytes, Shape]:
            self._turn += 1
            turns = [ids[i:] + ids[:i] for i in ((self._turn + k) % len(ids) for k in range(len(ids)))]
            shapes = [(Part(protocol.BROADCAST, len(ids) * step, turn),) for turn in turns]
            shape = min(shapes, key=self._doubted_since_s)
            return protocol.sync_read(address, length, shape[0].order, fast=True), shape

        data = self._exchange(request, ids, until_s)[0].parameters
        blocks = {data[at + 1]: data[at : at + step] for at in range(0, len(data), step)}
        for id_, block in blocks.items():
            _check(id_, block[0])
        return {id_: blocks[id_][2 : 2 + length] for id_ in ids}

    def hardware_error(self, id_: int, until_s: float) -> int:
        """Return the hardware error code, which is the cause of a servo's alert."""
        request = protocol.read(id_, HARDWARE_ERROR, 1)
        return self._exchange(lambda: (request, (Part(id_, 2),)), (id_,), until_s)[0].parameters[1]

    def until_s(self, attempts: int, answer_bytes: int) -> float:
        """Return when this many attempts will be over, including the time of the bytes on the line."""
        return now_s() + attempts * (self._timeout_s + answer_bytes * self._link.byte_s)

    def sync_write(self, address: int, length: int, values: dict[int, bytes], until_s: float) -> None:
        """Write a block of each servo, without acknowledgement."""
        self._link.write(protocol.sync_write(address, length, values), until_s)

    def _ask(self, request: bytes, ids: tuple[int, ...], length: int, until_s: float) -> dict[int, bytes]:
        shape = tuple(Part(id_, 1 + length) for id_ in ids)
        packets = self._exchange(lambda: (request, shape), ids, until_s)
        for packet in packets:
            _check(packet.id, packet.parameters[0])
        return {packet.id: packet.parameters[1:] for packet in packets}

    def _exchange(
        self, request: Callable[[], tuple[bytes, Shape]], ids: tuple[int, ...], until_s: float
    ) -> list[protocol.Packet]:
        """Send a request and read its answer; ask again after a lost answer while time remains."""
        while True:
            try:
                self._wait_for_late(until_s)
                frame, shape = request()
                is_probe, self._is_probe = self._is_probe, False
                if not (self._is_clear or is_probe):
                    self._probe(ids[0], FIRST_PROBES, until_s)
                elif self._is_awaited(shape):
                    self._probe(ids[0], PROBES, until_s)
                return self._attempt(frame, shape, ids, until_s)
            except NoAnswer:
                if until_s - now_s() < 0.5 * self._timeout_s:
                    raise

    def _attempt(self, request: bytes, shape: Shape, ids: tuple[int, ...], until_s: float) -> list[protocol.Packet]:
        self._note_late(self._packets(drain(self._link)))
        self._framer.reset()  # an incomplete frame is noise by now
        self.asked_s = now_s()
        self._link.write(request, until_s)
        self._unanswered.append(shape)
        found: list[protocol.Packet] = []
        odd: list[protocol.Packet] = []
        line_s = (len(request) + sum(part.size + PACKET_BYTES for part in shape)) * self._link.byte_s
        end_s = min(until_s, self.asked_s + self._timeout_s + line_s)
        while chunk := self._link.read(end_s):
            end_s = min(until_s, max(end_s, now_s() + self._timeout_s))  # the answer is arriving in pieces
            for packet in self._packets(chunk):
                if shape[len(found)].fits(packet):
                    found.append(packet)
                elif packet.id in ids and len(packet.parameters) == 1 and packet.parameters[0]:
                    self._unanswered.remove(shape)
                    _check(packet.id, packet.parameters[0])
                else:
                    odd.append(packet)
                if len(found) == len(shape):
                    self._is_answered(shape)
                    return found
        self._lost_in_a_row += 1
        self._note_late(odd)
        missing = f"{len(shape) - len(found)} of {len(shape)} answers did not arrive"
        what = f"servos {', '.join(map(str, ids))}: {missing}"
        if len(ids) == 1:
            what = f"servo {ids[0]} does not answer"
        self._why = what + "".join(f"; servo {x.id} sent {len(x.parameters)} bytes" for x in odd[:1])
        raise NoAnswer(self._why)

    def _is_answered(self, shape: Shape) -> None:
        """Record that this shape was answered: the bus answers in order, so earlier lost answers are unlikely to come."""
        self._overtaken += [(self.asked_s, lost) for lost in self._unanswered if lost != shape]
        self._unanswered.clear()
        self._lost_in_a_row = 0
        self._is_clear = True

    def _is_awaited(self, shape: Shape) -> bool:
        return any(set(shape) & set(lost) for lost in self._unanswered)

    def _doubted_since_s(self, shape: Shape) -> float:
        """Return when an answer of this shape was last lost: inf if still awaited, 0 if never or too long ago."""
        if self._is_awaited(shape):
            return math.inf
        lost_s = [then_s for then_s, lost in self._overtaken if set(shape) & set(lost)]
        return max([then_s for then_s in lost_s if now_s() - then_s < DOUBT_S], default=0.0)

    def _wait_for_late(self, until_s: float) -> None:
        """Listen for late answers after a second loss, longer the more were lost.

        Raises:
            NoAnswer: the pause exceeds the caller's time limit.
        """
        if self._lost_in_a_row < 2:
            return
        pause_s = min(QUARANTINE_S * 2.0 ** (self._lost_in_a_row - 2), LONGEST_QUARANTINE_S)
        end_s = self.asked_s + self._timeout_s + pause_s
        while self._unanswered and now_s() < end_s:
            chunk = self._link.read(min(end_s, until_s))
            self._note_late(self._packets(chunk))
            if not chunk and until_s < end_s:
                raise NoAnswer(self._why)

    def _probe(self, id_: int, lengths: Iterable[int], until_s: float) -> None:
        """Send a request that no lost answer fits, so that later answers cannot be confused.

        Raises:
            NoAnswer: the line is not known to be clear yet.
        """
        shapes = [(Part(id_, 1 + length),) for length in lengths]
        free = [shape for shape in shapes if not self._is_awaited(shape)]
        if not free:  # the servo is off, or so slow that it must be given time
            drain_until_quiet(self._link, quiet_s=self._timeout_s + QUARANTINE_S, until_s=until_s)
        else:
            with suppress(Refused):  # an error report is an answer too
                self._attempt(protocol.read(id_, 0, free[0][0].size - 1), free[0], (id_,), until_s)
        self._unanswered.clear()
        self._is_clear = True

    def _note_late(self, packets: Iterable[protocol.Packet]) -> None:
        """Handle answers to abandoned requests: these and earlier requests are no longer waited for."""
        for packet in packets:
            fits = [i for i, lost in enumerate(self._unanswered) if lost[-1].fits(packet)]
            if fits:
                del self._unanswered[: fits[0] + 1]

    def _packets(self, chunk: bytes) -> list[protocol.Packet]:
        """Return the status packets; other packets are the echo of our own."""
        packets = [_unpacked(frame) for frame in self._framer.feed(chunk)]
        return [packet for packet in packets if packet.instruction == protocol.STATUS]


@contextmanager
def naming_alerts(client: DynamixelClient, ids: tuple[int, ...], until_s: float) -> Iterator[None]:
    """Re-raise a hardware alert that occurs inside, naming its servo and cause."""
    try:
        yield
    except Refused as error:
        if not error.code & protocol.ALERT:
            raise
        causes = {id_: fault for id_ in ids if (fault := client.hardware_error(id_, until_s))}
        told = "; ".join(f"servo {id_} reports {fault_text(fault)}" for id_, fault in causes.items())
        raise Refused(told or str(error), code=error.code, hint=REBOOT) from error


def fault_text(fault: int) -> str:
    """Return the bits of a hardware error in words."""
    return ", ".join(text for bit, text in HARDWARE_BITS.items() if fault >> bit & 1) or f"hardware error {fault:02X}h"


def dynamixel_bus(context: Context, options: BusOptions) -> Bus[DynamixelClient]:
    """Return the bus of this port; devices that name the same port share one bus."""
    opener, name = serial_opener(options, context.name)

    def make() -> Bus[DynamixelClient]:
        return Bus(name, open_link=opener, client=lambda link: DynamixelClient(link, timeout_s=options.timeout_s))

    return context.shared.get(f"dynamixel {name}", make)


def _check(id_: int, error: int) -> None:
    if error & ~protocol.ALERT:
        text = protocol.ERRORS.get(error & ~protocol.ALERT, "not in the manual")
        raise Refused(f"servo {id_}: error {error & ~protocol.ALERT} ({text})", code=error)
    if error & protocol.ALERT:
        raise Refused(f"servo {id_}: hardware alert", code=error, hint=REBOOT)


def _unpacked(frame: bytes) -> protocol.Packet:
    """Decode a frame; fast sync answers are not stuffed, so removing stuffing could damage them."""
    if frame[4] == protocol.BROADCAST and frame[7] == protocol.STATUS:
        return protocol.Packet(frame[4], frame[7], frame[8:])  # with the last CRC: all blocks have one size
    return protocol.decode(frame)
