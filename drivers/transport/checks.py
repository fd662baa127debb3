"""Checksums of the protocols; each docstring gives the check value, the result for ASCII `123456789`."""

from __future__ import annotations


def _reflected_table(poly: int) -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ poly if crc & 1 else crc >> 1
        table.append(crc)
    return tuple(table)


def _straight_table(poly: int) -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ poly) & 0xFFFF if crc & 0x8000 else crc << 1
        table.append(crc)
    return tuple(table)


_MODBUS = _reflected_table(0xA001)
_X25 = _reflected_table(0x8408)
_DYNAMIXEL = _straight_table(0x8005)


def crc_modbus(data: bytes) -> int:
    """CRC-16/MODBUS, sent low byte first (Modbus over serial line V1.02, 6.2.2). Check 4B37."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ byte) & 0xFF]
    return crc


def crc_dynamixel(data: bytes, crc: int = 0) -> int:
    """CRC-16/BUYPASS of Dynamixel protocol 2.0, over header to parameters with the stuffing. Check FEE8."""
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _DYNAMIXEL[(crc >> 8) ^ byte]
    return crc


def crc_x25(data: bytes) -> int:
    """CRC-16/X-25 (Bota SensONE), sent low byte first. Check 906E."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _X25[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF


def crc_sick(data: bytes) -> int:
    """Check word of the SICK LMS 2xx family: one shift per byte, over the byte and its predecessor. Check A656."""
    crc = previous = 0
    for byte in data:
        crc = (crc & 0x7FFF) << 1 ^ (0x8005 if crc & 0x8000 else 0)
        crc ^= byte | previous << 8
        previous = byte
    return crc


def sum_scip(data: bytes) -> int:
    """Check character of a SCIP 2.0 line: the low six bits of the sum, mapped to printable characters."""
    return (sum(data) & 0x3F) + 0x30


def sum_low_byte(data: bytes) -> int:
    """Low byte of the sum (Benewake)."""
    return sum(data) & 0xFF


def xor_byte(data: bytes) -> int:
    """Exclusive or of all bytes (RPLIDAR requests, CoLa B)."""
    result = 0
    for byte in data:
        result ^= byte
    return result
