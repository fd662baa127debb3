"""Configures the drives of a CANopen arm by SDO, resuming where a lost link interrupted it (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Protocol

from drivers.transport.can_frames import CanFrame, record, records
from drivers.transport.link import Link, NoAnswer, Refused, now_s

SDO_ANSWER, SDO_REQUEST, HEARTBEAT = 0x580, 0x600, 0x700
BOOT_UP = b"\x00"
UPLOAD_SEGMENT, UPLOADED, DOWNLOADED, ABORTED = 0, 2, 3, 4  # top three bits of an answer
EXPEDITED, LAST, TOGGLE = 0x02, 0x01, 0x10
MAPPINGS = {0x1600: (0x60400010, 0x607A0020), 0x1A00: (0x60410010, 0x60640020)}
CONSUMER, PRODUCER, MODE = 0x1016, 0x1017, 0x6060  # heartbeats and mode of operation
# Objects that every configured drive has, requested in turn, so that a late answer to an old probe names another object.
PROBES = ((CONSUMER, 1), (PRODUCER, 0), (MODE, 0), *((index, sub) for index in MAPPINGS for sub in (1, 2)))
CSP = 8
SDO_S = 0.25
ATTEMPTS = 3
ABORTS = {
    0x05030000: "toggle bit",
    0x05040001: "command",
    0x06010002: "read-only",
    0x06020000: "no such object",
    0x06070010: "length",
    0x06090011: "no such sub-index",
    0x06090030: "value",
    0x08000000: "general error",
}


def upload_request(index: int, sub: int) -> bytes:
    """Return the request of an expedited SDO read."""
    return struct.pack("<BHB4x", 0x40, index, sub)


@dataclass(frozen=True, slots=True)
class Parameter:
    """Object to write to every drive; without `data`, `value` is written in the size that the object has."""

    index: int
    sub: int
    value: int
    data: bytes | None


class Objects(Protocol):
    """Reads and writes objects of the drives."""

    def upload(self, node: int, index: int, sub: int) -> int:
        """Return the value of an object, unsigned."""
        ...

    def read(self, node: int, index: int, sub: int) -> bytes:
        """Return the bytes of an object."""
        ...

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object."""
        ...


class SdoClient:
    """SDO client for up to four bytes; each transfer is repeated on its own, which is safe because it names its object.

    Args:
        answer_s: how long to wait for an answer.
        restarted: called with the id of a node that has restarted meanwhile.

    Raises:
        NoAnswer: no answer from that node. Refused: SDO abort.
    """

    def __init__(
        self, link: Link, *, answer_s: float = SDO_S, restarted: Callable[[int], None] = lambda _: None
    ) -> None:
        self._link = link
        self._answer_s = answer_s
        self._restarted = restarted

    def upload(self, node: int, index: int, sub: int) -> int:
        """Return the value of an object, unsigned."""
        return int.from_bytes(self.read(node, index, sub), "little")

    def read(self, node: int, index: int, sub: int) -> bytes:
        """Return the bytes of an object."""
        answer = self._transfer(node, upload_request(index, sub), UPLOADED)
        if not answer[0] & EXPEDITED:
            return self._segments(node)
        return answer[4 : 8 - (answer[0] >> 2 & 3)]

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object of up to four bytes."""
        command = 0x23 | (4 - len(data)) << 2
        self._transfer(node, struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"), DOWNLOADED)

    def _segments(self, node: int) -> bytes:
        """Return data that a drive sends in segments although it would fit into its first answer, which the standard allows."""
        data, toggle = b"", 0
        while True:
            answer = self._exchange(node, bytes([0x60 | toggle, *7 * [0]]), lambda a: a[0] >> 5 in (0, ABORTED))
            if answer is None or answer[0] & TOGGLE != toggle:
                raise NoAnswer(f"node {node} did not complete a segmented SDO transfer")
            self._checked(node, answer)
            data += answer[1 : 8 - (answer[0] >> 1 & 7)]
            if answer[0] & LAST:
                return data
            toggle ^= TOGGLE

    def _transfer(self, node: int, request: bytes, kind: int) -> bytes:
        def is_answer(answer: bytes) -> bool:
            return answer[0] >> 5 in (kind, ABORTED) and answer[1:4] == request[1:4]

        for _ in range(ATTEMPTS):
            if (answer := self._exchange(node, request, is_answer)) is not None:
                return self._checked(node, answer)
        raise NoAnswer(f"node {node} does not answer; is it powered, and is the bit rate right?")

    def _exchange(self, node: int, request: bytes, is_answer: Callable[[bytes], bool]) -> bytes | None:
        self._link.write(record(CanFrame(SDO_REQUEST + node, request)), now_s() + self._answer_s)
        until_s, found = now_s() + self._answer_s, None
        while found is None and (chunk := self._link.read(until_s)):
            for id_, data, _ in records(chunk):
                if id_ & ~0x7F == HEARTBEAT and data == BOOT_UP:
                    self._restarted(id_ & 0x7F)
                if id_ == SDO_ANSWER + node and len(data) == 8 and is_answer(data):
                    found = data
        return found

    @staticmethod
    def _checked(node: int, answer: bytes) -> bytes:
        if answer[0] >> 5 != ABORTED:
            return answer
        code = int.from_bytes(answer[4:], "little")
        index = int.from_bytes(answer[1:3], "little")
        text = ABORTS.get(code, "see CiA 301")
        raise Refused(f"node {node}: object {index:04X}h: SDO abort {code:08X}h ({text})", code=code)


class SetUp:
    """Configuration of every drive before it may run: heartbeat monitoring, its own heartbeat, CSP, and our PDO mappings.

    A drive configured in an earlier attempt still has the value that was written to 1016h; one that was power-cycled
    since then has lost it and is configured from the start.

    Args:
        consumer: value of 1016h:1, the host's node id and its time-out.
        producer_ms: period of the drive's own heartbeat.
        parameters: further objects to write, in this order.
    """

    def __init__(
        self, nodes: Iterable[int], *, consumer: int, producer_ms: int, parameters: Iterable[Parameter] = ()
    ) -> None:
        self._consumer = consumer
        self._done = dict.fromkeys(nodes, 0)
        self._restarts = 0
        self._steps: tuple[Callable[[Objects, int], None], ...] = (
            lambda sdo, node: sdo.download(node, CONSUMER, 1, struct.pack("<I", consumer)),
            lambda sdo, node: sdo.download(node, PRODUCER, 0, struct.pack("<H", producer_ms)),
            lambda sdo, node: sdo.download(node, MODE, 0, struct.pack("<b", CSP)),
            *map(_writing, parameters),
            *(self._mapping_check(index, sub) for index in MAPPINGS for sub in (1, 2)),
        )

    def run(self, sdo: Objects) -> None:
        """Complete the configuration of all drives."""
        for node, done in self._done.items():
            if done and sdo.upload(node, CONSUMER, 1) != self._consumer:
                self.forget(node)
        while unfinished := [node for node, done in self._done.items() if done < len(self._steps)]:
            node, restarts = unfinished[0], self._restarts
            self._steps[self._done[node]](sdo, node)
            self._done[node] += restarts == self._restarts

    def forget(self, node: int) -> None:
        """Restart the configuration of this node, because the drive has restarted."""
        if node in self._done:
            self._done[node] = 0
            self._restarts += 1

    @staticmethod
    def _mapping_check(index: int, sub: int) -> Callable[[Objects, int], None]:
        wanted = MAPPINGS[index][sub - 1]

        def check(sdo: Objects, node: int) -> None:
            mapped = sdo.upload(node, index, sub)
            if mapped != wanted:
                what = f"node {node}: object {index:04X}h:{sub} maps {mapped:08X}, not {wanted:08X}"
                raise Refused(
                    what,
                    code=index,
                    hint="with the manufacturer's tool give its PDOs the mapping of docs/reference/drivers.md",
                )

        return check


def _writing(parameter: Parameter) -> Callable[[Objects, int], None]:
    """Return the step that writes one object."""
    index, sub, value, data = parameter.index, parameter.sub, parameter.value, parameter.data

    def write(sdo: Objects, node: int) -> None:
        size = len(data) if data is not None else len(sdo.read(node, index, sub))
        try:
            sdo.download(node, index, sub, data or value.to_bytes(size, "little", signed=value < 0))
        except OverflowError as error:
            what = f"node {node}: {value} does not fit into object {index:04X}h:{sub}, which has {size} bytes"
            raise Refused(
                what, code=index, hint="correct `parameters`; with `eds` they are checked beforehand"
            ) from error

    return write
