"""Modbus far side for RTU and TCP: pymodbus' server classes answer from a register map; ports and faults are ours."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Sequence
from typing import Any, Protocol

from pymodbus.constants import ExcCodes
from pymodbus.exceptions import NoSuchIdException
from pymodbus.framer import FramerType
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
from pymodbus.pdu.mei_message import ReadDeviceInformationRequest, ReadDeviceInformationResponse
from pymodbus.server import ModbusTcpServer
from pymodbus.server.requesthandler import ServerRequestHandler
from pymodbus.simulator import DataType, SimData, SimDevice
from pymodbus.simulator.simcore import SimCore

from drivers.emulators.base import WireEmulator
from drivers.emulators.faults import FaultOptions
from drivers.emulators.ports import FarPort, Peer, PtyPort
from drivers.transport.checks import crc_modbus
from drivers.transport.framing import Framer
from hal.errors import CellError

ILLEGAL_ADDRESS = ExcCodes.ILLEGAL_ADDRESS
VENDOR, REVISION = b"panelwright", b"1.0"
MBAP = 7
REQUESTS = DecodePDU(is_server=True)


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


class MapContext(SimCore):
    """Data store of pymodbus' server, which reads and writes a register map in place of memory.

    Args:
        unit: the unit that answers; None for every unit, as behind a TCP address of its own.
    """

    def __init__(self, table: RegisterMap, unit: int | None) -> None:
        super().__init__(SimDevice(0, simdata=SimData(0, datatype=DataType.REGISTERS)))
        self._table = table
        self._unit = unit
        self._written: list[Any] = []

    async def async_getValues(  # noqa: N802  # named by pymodbus
        self, device_id: int, func_code: int, address: int, count: int = 1
    ) -> list[Any] | ExcCodes:
        """Return bits or registers; after a write of one value (functions 5 and 6), that value, which is acknowledged."""
        self._require(device_id)
        try:
            match func_code:
                case 1 | 2:
                    return list(self._table.read_bits(func_code, address, count))
                case 5 | 6:
                    return self._written
                case _:
                    return list(self._table.read_registers(4 if func_code == 4 else 3, address, count))
        except (ModbusException, CellError) as error:
            return _code(error)

    async def async_setValues(  # noqa: N802  # named by pymodbus
        self, device_id: int, func_code: int, address: int, values: list[Any]
    ) -> ExcCodes | None:
        """Write coils (functions 5 and 15) or registers."""
        self._require(device_id)
        try:
            write = self._table.write_bits if func_code in (5, 15) else self._table.write_registers
            write(address, values)
        except (ModbusException, CellError) as error:
            return _code(error)
        self._written = list(values)
        return None

    def _require(self, unit: int) -> None:
        if self._unit not in (None, unit):
            raise NoSuchIdException(f"unit {unit}")


def _code(error: ModbusException | CellError) -> ExcCodes:
    return ExcCodes(error.code) if isinstance(error, ModbusException) else ExcCodes.DEVICE_FAILURE


class Connection(ServerRequestHandler):
    """Connection of one host: pymodbus decodes, carries out and encodes; the emulator sends."""

    def __init__(self, far_side: ModbusFarSide, server: ModbusTcpServer, peer: Peer) -> None:
        super().__init__(server, None, None, None)  # type: ignore[no-untyped-call]
        self._far_side = far_side
        self._peer = peer

    def callback_data(self, data: bytes, addr: tuple[Any, ...] | None = None) -> int:
        """Decode one request."""
        used = super().callback_data(data, addr)
        if self.last_pdu is not None:
            self._far_side.last_function = self.last_pdu.function_code
        return used

    async def respond(self, frame: bytes) -> None:
        """Answer one request; identification is answered here, because pymodbus has one identity per process."""
        self.callback_data(frame)
        request = self.last_pdu
        if isinstance(request, ReadDeviceInformationRequest):
            self.server_send(self._far_side.identity(request), None)  # type: ignore[no-untyped-call]
        else:
            await self.handle_request()  # type: ignore[no-untyped-call]

    def handle_later(self) -> None:
        """Do nothing: `respond` has answered."""

    def send(self, data: bytes, addr: tuple[Any, ...] | None = None) -> None:  # noqa: ARG002  # one peer
        """Send an answer through the emulator's faults."""
        self._far_side.deliver(self._peer, data)


class ModbusFarSide(WireEmulator):
    """Modbus server on a pty (RTU) or a TCP listener."""

    def __init__(self, port: FarPort, options: FaultOptions, table: RegisterMap, *, unit: int, name: str) -> None:
        super().__init__(port, options, name=name)
        self._unit = unit
        self._name = name
        self._is_rtu = isinstance(port, PtyPort)
        self._context = MapContext(table, unit if self._is_rtu else None)
        self._rtu = Framer(bytes([unit]), _rtu_request_length, lambda f: crc_modbus(f) == 0)
        self._tcp: dict[Peer, bytes] = {}
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: ModbusTcpServer | None = None
        self._connections: dict[Peer, Connection] = {}
        self.last_function = 0

    def on_bytes(self, peer: Peer, data: bytes) -> None:
        """Answer each complete request."""
        for frame in self._rtu.feed(data) if self._is_rtu else self._tcp_frames(peer, data):
            loop = self._loop = self._loop or asyncio.new_event_loop()
            loop.run_until_complete(self._respond(peer, frame))

    def _tcp_frames(self, peer: Peer, data: bytes) -> list[bytes]:
        buffer, frames = self._tcp.get(peer, b"") + data, []
        while len(buffer) > MBAP and len(buffer) >= (end := 6 + struct.unpack_from(">H", buffer, 4)[0]):
            frames.append(buffer[:end])
            buffer = buffer[end:]
        self._tcp[peer] = buffer
        return frames

    async def _respond(self, peer: Peer, frame: bytes) -> None:
        if self._server is None:
            framer = FramerType.RTU if self._is_rtu else FramerType.SOCKET
            device = SimDevice(0, simdata=SimData(0, datatype=DataType.REGISTERS))
            self._server = ModbusTcpServer(device, framer=framer, ignore_missing_devices=True)
            self._server.context = self._context
        if peer not in self._connections:
            self._connections[peer] = Connection(self, self._server, peer)
        await self._connections[peer].respond(frame)

    def identity(self, request: ReadDeviceInformationRequest) -> ModbusPDU:
        """Return the answer to a request for the device's identification."""
        texts = {0: VENDOR, 1: self._name.encode(), 2: REVISION}
        answer = ReadDeviceInformationResponse(read_code=request.read_code, information=texts, dev_id=request.dev_id)
        answer.transaction_id = request.transaction_id
        return answer

    def deliver(self, peer: Peer, frame: bytes) -> None:
        """Send an answer through the fault plan."""
        self.send(peer, frame, protected=slice(None) if self._is_rtu else slice(0, 8))

    def status_frame(self) -> bytes | None:
        """Return Modbus exception 4, device failure, for RTU; None for TCP."""
        if not self._is_rtu:
            return None
        answer = ExceptionResponse(self.last_function, ExcCodes.DEVICE_FAILURE)
        frame = bytes([self._unit, answer.function_code]) + answer.encode()
        return frame + struct.pack("<H", crc_modbus(frame))

    def close(self) -> None:
        """End the thread and close the port and the server's event loop; a second call does nothing."""
        super().close()
        loop, self._loop = self._loop, None
        if loop is not None and not loop.is_running():
            loop.close()


def _rtu_request_length(data: bytes) -> int | None:
    """Return the length of the RTU request at the start of `data`; None if not yet known, 0 if it is no request."""
    if len(data) < 3:
        return None
    kind = None if data[1] & 0x80 else REQUESTS.lookupPduClass(data)
    if kind is None or not (kind.rtu_frame_size or kind.rtu_byte_count_pos):
        return 0
    return kind.calculateRtuFrameSize(data) or None
