"""Compares checksums with published check values and with bit-by-bit definitions."""

import binascii
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.transport.checks import (
    crc_dynamixel,
    crc_modbus,
    crc_sick,
    crc_x25,
    sum_low_byte,
    sum_scip,
    xor_byte,
)

DIGITS = b"123456789"


@pytest.mark.parametrize(
    ("check", "value"), [(crc_modbus, 0x4B37), (crc_dynamixel, 0xFEE8), (crc_x25, 0x906E), (crc_sick, 0xA656)]
)
def test_the_nine_digits_give_the_published_check_value(check: Callable[[bytes], int], value: int) -> None:
    assert check(DIGITS) == value


def bitwise(data: bytes, *, poly: int, start: int) -> int:
    """Return a CRC by its definition, one bit at a time, least significant bit first."""
    crc = start
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ poly if crc & 1 else crc >> 1
    return crc


@given(st.binary(max_size=40))
def test_tables_agree_with_the_definition(data: bytes) -> None:
    assert crc_modbus(data) == bitwise(data, poly=0xA001, start=0xFFFF)
    assert crc_x25(data) == bitwise(data, poly=0x8408, start=0xFFFF) ^ 0xFFFF


@given(st.binary(max_size=40))
def test_the_dynamixel_crc_is_linear_over_its_own_remainder(data: bytes) -> None:
    crc = crc_dynamixel(data)
    assert crc_dynamixel(data + bytes([crc >> 8, crc & 0xFF])) == 0


@given(st.binary(min_size=1, max_size=40), st.integers(min_value=0))
def test_every_single_bit_error_is_seen(data: bytes, place: int) -> None:
    at, bit = divmod(place % (8 * len(data)), 8)
    wrong = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
    for check in (crc_modbus, crc_dynamixel, crc_x25, sum_low_byte, xor_byte):
        assert check(wrong) != check(data)


def test_scip_sum_of_the_manuals_examples() -> None:
    assert chr(sum_scip(b"00")) == "P"
    assert chr(sum_scip(b"99")) == "b"


def test_the_sick_crc_is_not_a_standard_one() -> None:
    assert crc_sick(DIGITS) != binascii.crc_hqx(DIGITS, 0)
