"""Configures the drives of a CANopen arm by SDO, and goes on where a lost wire ended it (CiA 301, 7.2.4)."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable
from typing import Protocol

from drivers.transport.canbus import CanCodec, CanFrame
from drivers.transport.link import Link, NoAnswer, Refused, now_s

SDO_ANSWER, SDO_REQUEST = 0x580, 0x600
MAPPINGS = {0x1600: (0x60400010, 0x607A0020), 0x1A00: (0x60410010, 0x60640020)}
CONSUMER, PRODUCER, MODE = 0x1016, 0x1017, 0x6060  # heartbeats and mode of operation
# Objects that every configured drive has, asked in turn: so many that the answer to an old probe names another one.
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
    """Expedited SDO read."""
    return struct.pack("<BHB4x", 0x40, index, sub)


class Objects(Protocol):
    """Objects of drives, read and written."""

    def upload(self, node: int, index: int, sub: int) -> int:
        """Value of an object, unsigned."""
        ...

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object."""
        ...


class SdoClient:
    """Expedited transfers; each is repeated by itself, as it names what it is about and changes nothing twice.

    Args:
        answer_s: how long an answer is waited for.

    Raises:
        NoAnswer: nobody answers as that node. Refused: SDO abort.
    """

    def __init__(self, link: Link, codec: CanCodec, *, answer_s: float = SDO_S) -> None:
        self._link = link
        self._codec = codec
        self._answer_s = answer_s

    def upload(self, node: int, index: int, sub: int) -> int:
        """Value of an object, unsigned."""
        answer = self._transfer(node, upload_request(index, sub))
        size = 4 - (answer[0] >> 2 & 3)
        return int.from_bytes(answer[4 : 4 + size], "little")

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        """Write an object of up to four bytes."""
        command = 0x23 | (4 - len(data)) << 2
        self._transfer(node, struct.pack("<BHB", command, index, sub) + data.ljust(4, b"\0"))

    def _transfer(self, node: int, request: bytes) -> bytes:
        for _ in range(ATTEMPTS):
            self._link.write(self._codec.encode(CanFrame(SDO_REQUEST + node, request)), now_s() + self._answer_s)
            until_s = now_s() + self._answer_s
            while chunk := self._link.read(until_s):
                for frame in self._codec.feed(chunk):
                    is_answer = frame.id == SDO_ANSWER + node and len(frame.data) == 8
                    if is_answer and frame.data[1:4] == request[1:4]:
                        return self._checked(node, frame.data)
        raise NoAnswer(f"node {node} does not answer; is it powered, and is the bit rate right?")

    @staticmethod
    def _checked(node: int, answer: bytes) -> bytes:
        if answer[0] != 0x80:
            return answer
        code = int.from_bytes(answer[4:], "little")
        index = int.from_bytes(answer[1:3], "little")
        text = ABORTS.get(code, "see CiA 301")
        raise Refused(f"node {node}: object {index:04X}h: SDO abort {code:08X}h ({text})", code=code)


class SetUp:
    """What every drive needs before it may run: our heartbeat watched, its own sent, CSP, and the PDO mappings we know.

    A drive that was configured in an earlier attempt still has what we wrote to 1016h; one that was switched off since has
    lost it and begins anew.

    Args:
        consumer: value of 1016h:1, our node and how long it may be silent.
        producer_ms: the drive's own heartbeat.
    """

    def __init__(self, nodes: Iterable[int], *, consumer: int, producer_ms: int) -> None:
        self._consumer = consumer
        self._done = dict.fromkeys(nodes, 0)
        self._steps: tuple[Callable[[Objects, int], None], ...] = (
            lambda sdo, node: sdo.download(node, CONSUMER, 1, struct.pack("<I", consumer)),
            lambda sdo, node: sdo.download(node, PRODUCER, 0, struct.pack("<H", producer_ms)),
            lambda sdo, node: sdo.download(node, MODE, 0, struct.pack("<b", CSP)),
            *(self._mapping_check(index, sub) for index in MAPPINGS for sub in (1, 2)),
        )

    def run(self, sdo: Objects) -> None:
        """Bring all drives to the end of it."""
        for node, done in self._done.items():
            if done and sdo.upload(node, CONSUMER, 1) != self._consumer:
                self.forget(node)
        for node in self._done:
            for step in self._steps[self._done[node] :]:
                step(sdo, node)
                self._done[node] += 1

    def forget(self, node: int) -> None:
        """The drive has started again."""
        self._done[node] = 0

    @staticmethod
    def _mapping_check(index: int, sub: int) -> Callable[[Objects, int], None]:
        wanted = MAPPINGS[index][sub - 1]

        def check(sdo: Objects, node: int) -> None:
            mapped = sdo.upload(node, index, sub)
            if mapped != wanted:
                raise Refused(f"node {node}: object {index:04X}h:{sub} maps {mapped:08X}, not {wanted:08X}", code=index)

        return check
