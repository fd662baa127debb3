"""Modbus requests in the PDU classes of pymodbus, each with the form that its answer must have.

Importing pymodbus takes 60 ms of CPU time, so `drivers.transport.modbus` imports this module when a link is opened.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

from pymodbus.constants import MoreData
from pymodbus.pdu import ExceptionResponse, ModbusPDU
from pymodbus.pdu.bit_message import (
    ReadCoilsRequest,
    ReadCoilsResponse,
    ReadDiscreteInputsRequest,
    ReadDiscreteInputsResponse,
    WriteMultipleCoilsRequest,
    WriteMultipleCoilsResponse,
)
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersRequest,
    ReadHoldingRegistersResponse,
    ReadInputRegistersRequest,
    ReadInputRegistersResponse,
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

REFUSALS = tuple(bytes([function | 0x80]) for function in range(0x80))  # first byte of a refusal, by function
BIT_READS = {1: (ReadCoilsRequest, ReadCoilsResponse), 2: (ReadDiscreteInputsRequest, ReadDiscreteInputsResponse)}
REGISTER_READS = {
    3: (ReadHoldingRegistersRequest, ReadHoldingRegistersResponse),
    4: (ReadInputRegistersRequest, ReadInputRegistersResponse),
}


@dataclass(frozen=True, slots=True)
class Question:
    """Request and the form of its answer.

    Attributes:
        request: function code and data.
        head: the first bytes of the answer, as far as the request determines them.
        kind: class that decodes the answer.
    """

    request: bytes
    head: bytes
    kind: type[ModbusPDU]

    @property
    def function(self) -> int:
        """Return the function code."""
        return self.request[0]

    @property
    def forms(self) -> tuple[tuple[bytes, type[ModbusPDU]], ...]:
        """Return how an answer and how a refusal begin, with the class of each."""
        return (self.head, self.kind), (REFUSALS[self.head[0]], ExceptionResponse)


@lru_cache(maxsize=256)  # a poll asks the same again and again
def read_bits(function: int, address: int, count: int) -> Question:
    """Return a request for coils (function 1) or discrete inputs (2)."""
    request, kind = BIT_READS[function]
    return Question(_pdu(request(address=address, count=count)), bytes([function, (count + 7) // 8]), kind)


@lru_cache(maxsize=256)
def read_registers(function: int, address: int, count: int) -> Question:
    """Return a request for holding (function 3) or input (4) registers."""
    request, kind = REGISTER_READS[function]
    return Question(_pdu(request(address=address, count=count)), bytes([function, 2 * count]), kind)


def write_bits(address: int, values: Sequence[bool]) -> Question:
    """Return a request that writes consecutive coils (function 15); its answer repeats address and count."""
    request = _pdu(WriteMultipleCoilsRequest(address=address, bits=values))
    return Question(request, request[:5], WriteMultipleCoilsResponse)


def write_registers(address: int, values: Sequence[int]) -> Question:
    """Return a request that writes consecutive registers (function 16); its answer repeats address and count."""
    request = _pdu(WriteMultipleRegistersRequest(address=address, registers=values))
    return Question(request, request[:5], WriteMultipleRegistersResponse)


def read_identity(object_id: int = 0) -> Question:
    """Return a request for vendor, product and revision (function 43, type 14), from one of them on."""
    request = _pdu(ReadDeviceInformationRequest(object_id=object_id))
    return Question(request, request[:3], ReadDeviceInformationResponse)


def decode(question: Question, pdu: bytes) -> ModbusPDU:
    """Return the answer, or the refusal, that these bytes hold."""
    answer = question.kind() if pdu[0] == question.function else ExceptionResponse(question.function)
    answer.decode(pdu[1:])
    return answer


def identity_objects(answer: ModbusPDU) -> tuple[dict[int, str], int]:
    """Return the texts of an answer to `read_identity` by their number, and the number to go on from (0: that is all)."""
    assert isinstance(answer, ReadDeviceInformationResponse)  # noqa: S101  # for the type checker
    texts = {}
    for number, data in answer.information.items():
        first = data[0] if isinstance(data, list) else data
        texts[number] = first.decode("ascii", "replace").strip("\0 ")
    return texts, answer.next_object_id if answer.more_follows == MoreData.KEEP_READING else 0


def _pdu(request: ModbusPDU) -> bytes:
    return bytes([request.function_code]) + request.encode()
