"""Modbus server for RTU and TCP: answers request frames from a register map."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Protocol

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import FarPort, Peer, PtyPort
from drivers.transport.checks import crc_modbus
from drivers.transport.framing import Framer
from hal.errors import CellError

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE = 1, 2, 3, 4
MBAP = 7


class ModbusException(Exception):
    """Refusal of a request by the register map; `code` is sent to the client."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


class RegisterMap(Protocol):
    """Registers and bits of a Modbus device; each method raises `ModbusException` for an unknown address."""

    def read_bits(self, function: int, address: int, count: int) -> Sequence[bool]:
        """Return coils (function 1) or discrete inputs (function 2)."""
        ...

    def read_registers(self, function: int, address: int, count: int) -> Sequence[int]:
        """Return holding (function 3) or input (function 4) registers, unsigned."""
        ...

    def write_bits(self, address: int, values: Sequence[bool]) -> None:
        """Write coils."""
        ...

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Write holding registers."""
        ...


class RegistersOnly:
    """Register map without coils and discrete inputs, with the same holding and input registers."""

    def registers(self, address: int, count: int) -> Sequence[int]:
        """Return `count` registers from `address` on."""
        raise no_such(address, count)

    def write_registers(self, address: int, values: Sequence[int]) -> None:
        """Store the registers that the host writes."""
        raise no_such(address, *values)

    def read_registers(self, function: int, address: int, count: int) -> Sequence[int]:
        """Return the same registers for functions 3 and 4."""
        return self.registers(address, count) if function in (3, 4) else []

    def read_bits(self, function: int, address: int, count: int) -> Sequence[bool]:
        """Refuse: there are no coils or discrete inputs."""
        raise no_such(function, address, count)

    def write_bits(self, address: int, values: Sequence[bool]) -> None:
        """Refuse: there are no coils."""
        raise no_such(address, *values)


def no_such(*asked: int) -> ModbusException:
    """Return the exception for an illegal address; the request is attached as a note for debugging."""
    error = ModbusException(ILLEGAL_ADDRESS)
    error.add_note(f"asked: {asked}")
    return error


class ModbusFarSide(WireEmulator):
    """Modbus server on a pty (RTU) or a TCP listener."""

    def __init__(self, port: FarPort, options: FaultOptions, table: RegisterMap, *, unit: int, name: str) -> None:
        super().__init__(port, options, name=name)
        self._table = table
        self._unit = unit
        self._is_rtu = isinstance(port, PtyPort)
        self._rtu = Framer(bytes([unit]), _rtu_request_length, lambda f: crc_modbus(f) == 0)
        self._tcp: dict[Peer, bytes] = {}
        self._last_request = b""

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer each complete request."""
        if self._is_rtu:
            for frame in self._rtu.feed(data):
                answer = bytes([self._unit]) + self._answer(frame[1:-2])
                self.send(peer, answer + struct.pack("<H", crc_modbus(answer)))
            return
        buffer = self._tcp.get(peer, b"") + data
        while len(buffer) > MBAP and len(buffer) >= 6 + (size := struct.unpack_from(">H", buffer, 4)[0]):
            head, pdu, buffer = buffer[:MBAP], buffer[MBAP : 6 + size], buffer[6 + size :]
            answer = self._answer(pdu)
            self.send(peer, head[:4] + struct.pack(">HB", len(answer) + 1, head[6]) + answer, protected=slice(0, 8))
        self._tcp[peer] = buffer

    def status_frame(self) -> bytes | None:
        """Return Modbus exception 4, device failure, for RTU; None for TCP."""
        pdu = bytes([self._last_request[0] | 0x80, DEVICE_FAILURE])
        if self._is_rtu:
            return bytes([self._unit]) + pdu + struct.pack("<H", crc_modbus(bytes([self._unit]) + pdu))
        return None

    def _answer(self, pdu: bytes) -> bytes:
        self._last_request = pdu
        try:
            return answer_pdu(self._table, pdu)
        except ModbusException as error:
            return bytes([pdu[0] | 0x80, error.code])
        except CellError:
            return bytes([pdu[0] | 0x80, DEVICE_FAILURE])


def answer_pdu(table: RegisterMap, pdu: bytes) -> bytes:
    """Return the answer to one request, without unit and checksum (Modbus application protocol V1.1b3, chapter 6)."""
    function = pdu[0]
    if function not in (1, 2, 3, 4, 5, 6, 15, 16, 23):
        raise ModbusException(ILLEGAL_FUNCTION)
    address, number = struct.unpack_from(">HH", pdu, 1)
    match function:
        case 1 | 2:
            bits = table.read_bits(function, address, number)
            word = sum(1 << i for i, bit in enumerate(bits) if bit)
            data = word.to_bytes((number + 7) // 8, "little")
            return bytes([function, len(data)]) + data
        case 3 | 4:
            return _registers(function, table.read_registers(function, address, number))
        case 5:
            if number not in (0, 0xFF00):
                raise ModbusException(ILLEGAL_VALUE)
            table.write_bits(address, [number == 0xFF00])
        case 6:
            table.write_registers(address, [number])
        case 15:
            word = int.from_bytes(pdu[6:], "little")
            table.write_bits(address, [bool(word >> i & 1) for i in range(number)])
        case 16:
            table.write_registers(address, struct.unpack(f">{number}H", pdu[6 : 6 + 2 * number]))
        case _:
            write_address, write_count = struct.unpack_from(">HH", pdu, 5)
            table.write_registers(write_address, struct.unpack(f">{write_count}H", pdu[10 : 10 + 2 * write_count]))
            return _registers(function, table.read_registers(3, address, number))
    return pdu[:5]


def _registers(function: int, values: Sequence[int]) -> bytes:
    return bytes([function, 2 * len(values)]) + struct.pack(f">{len(values)}H", *values)


def _rtu_request_length(data: bytes) -> int | None:
    """Return the length of the RTU request at the start of `data`; None if not yet known, 0 if it is no request."""
    if len(data) < 2:
        return None
    function = data[1]
    if 1 <= function <= 6:
        return 8
    count_at = {15: 6, 16: 6, 23: 10}.get(function)
    if count_at is None:
        return 0
    return None if len(data) <= count_at else count_at + 1 + data[count_at] + 2
