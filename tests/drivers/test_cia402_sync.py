"""PDOs belong to SYNCs by count: late, lost, repeated and stray ones never pass for the newest."""

from __future__ import annotations

import itertools
import struct
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402_setup import CONSUMER, MAPPINGS, SetUp
from drivers.cia402_sync import PDOS, PROBE_S, SyncCount
from drivers.transport.link import NoAnswer, Refused

PERIOD_S = 0.01
Fate = int | None


def as_data(number: int, pdo: int) -> bytes:
    return struct.pack("<IB", number, pdo)


@given(st.lists(st.sampled_from([0, 0, 0, 1, 2, 5, None]), min_size=5, max_size=60))
def test_each_pdo_is_of_the_sync_that_it_is_said_to_be_of_on_a_drive_that_keeps_order(fates: list[Fate]) -> None:
    """Each answer comes so many periods late, holding up those behind it, or is lost."""
    count, wire = SyncCount(), deque[tuple[int, bytes | None, int]]()  # (period of arrival, PDO or probe, which)
    newest = [0] * PDOS
    fate, free_at = itertools.cycle(fates), 0
    for number in range(1, 200):
        if count.wants_probe(number * PERIOD_S):
            count.probed(number * PERIOD_S)
            later = next(fate)
            if later is not None:
                free_at = max(free_at, number + later)
                wire.append((free_at, None, count.probes))
        count.synced()
        for pdo in range(PDOS):
            later = next(fate)
            if later is not None:
                free_at = max(free_at, number + later)
                wire.append((free_at, as_data(number, pdo), pdo))
        while wire and wire[0][0] <= number:
            _, data, which = wire.popleft()
            if data is not None and count.took(which, data):
                newest[which] = struct.unpack("<IB", data)[0]
            elif data is None and which == count.probes:  # an older one names another object
                count.probe_answered()
            if count.answered is not None:
                assert newest == [count.answered] * PDOS


def test_a_drive_that_is_one_period_late_loses_nothing_as_the_probes_tell() -> None:
    count, answered = SyncCount(), []
    count.synced()
    for number in range(1, 5):
        assert count.wants_probe(number * PERIOD_S)
        count.probed(number * PERIOD_S)
        count.synced()
        for pdo in range(PDOS):
            assert count.took(pdo, as_data(number, pdo))
        assert count.answered is None, "it may be of the next SYNC, if that one's were lost"
        count.probe_answered()
        answered.append(count.answered)
    assert answered == [1, 2, 3, 4]


def test_when_all_pdos_of_a_sync_and_the_probe_are_lost_the_next_ones_are_not_taken_for_them() -> None:
    count = SyncCount()
    for number in range(1, 4):
        if count.wants_probe(number * PERIOD_S):
            count.probed(number * PERIOD_S)
        count.synced()
        if number != 2:
            for pdo in range(PDOS):
                count.took(pdo, as_data(number, pdo))
    assert count.answered is None
    count.probed(1.0)
    count.probe_answered()
    count.synced()
    for pdo in range(PDOS):
        count.took(pdo, as_data(4, pdo))
    assert count.answered == 4


def test_after_a_lost_pdo_a_probe_brings_the_numbers_together() -> None:
    count, answered = SyncCount(), []
    for number in range(1, 6):
        if count.wants_probe(number * PERIOD_S):
            count.probed(number * PERIOD_S)
            count.probe_answered()  # before the next SYNC's PDOs, as it was asked before
        count.synced()
        for pdo in range(PDOS):
            if (number, pdo) != (2, 0):
                count.took(pdo, as_data(number, pdo))
        answered.append(count.answered)
    assert answered == [1, None, 3, 4, 5]


def test_a_late_one_beside_a_young_one_makes_both_doubtful() -> None:
    count = SyncCount()
    count.synced()
    assert count.took(0, as_data(7, 0))
    assert not count.took(0, as_data(3, 0))
    assert count.took(1, as_data(7, 1))
    assert count.answered is None


def test_the_same_twice_is_no_matter() -> None:
    count = SyncCount()
    count.synced()
    for pdo in range(PDOS):
        assert count.took(pdo, as_data(1, pdo))
        assert not count.took(pdo, as_data(1, pdo))
    assert count.answered == 1


def test_a_lost_probe_is_asked_again() -> None:
    count = SyncCount()
    count.synced()
    assert count.wants_probe(0.0)
    count.probed(0.0)
    assert not count.wants_probe(0.5 * PROBE_S)
    assert count.wants_probe(1.5 * PROBE_S)


class Drives:
    """Objects of two drives; the wire breaks before each transfer whose number is in `breaks`."""

    def __init__(self, breaks: set[int]) -> None:
        self.objects = {
            node: {(index, sub + 1): value for index in MAPPINGS for sub, value in enumerate(MAPPINGS[index])}
            for node in (1, 2)
        }
        self.transfers = 0
        self._breaks = breaks

    def _count(self) -> None:
        self.transfers += 1
        if self.transfers in self._breaks:
            raise NoAnswer("unplugged")

    def upload(self, node: int, index: int, sub: int) -> int:
        self._count()
        return self.objects[node].get((index, sub), 0)

    def download(self, node: int, index: int, sub: int, data: bytes) -> None:
        self._count()
        self.objects[node][index, sub] = int.from_bytes(data, "little")


def set_up_of(drives: Drives) -> SetUp:
    return SetUp(drives.objects, consumer=0x7F0064, producer_ms=50)


def test_a_set_up_that_was_cut_goes_on_where_it_was() -> None:
    drives = Drives(breaks={5, 10, 15})
    set_up = set_up_of(drives)
    for _ in range(3):
        with pytest.raises(NoAnswer):
            set_up.run(drives)
    set_up.run(drives)
    assert all(objects[CONSUMER, 1] == 0x7F0064 for objects in drives.objects.values())
    assert drives.transfers <= 14 + 3 + 3 * 2, "all steps once, three broken, and a look at each drive that was begun"


def test_a_drive_that_was_switched_off_meanwhile_begins_anew() -> None:
    drives = Drives(breaks=set())
    set_up = set_up_of(drives)
    set_up.run(drives)
    first = drives.transfers
    del drives.objects[2][CONSUMER, 1]
    set_up.run(drives)
    assert drives.transfers == first + 2 + 7
    assert drives.objects[2][CONSUMER, 1] == 0x7F0064
    set_up.forget(1)
    drives.transfers = 0
    set_up.run(drives)
    assert drives.transfers == 1 + 7


def test_a_drive_that_maps_other_objects_is_refused() -> None:
    drives = Drives(breaks=set())
    drives.objects[2][0x1A00, 2] = 0x606C0020
    with pytest.raises(Refused, match=r"node 2: object 1A00h:2 maps 606C0020, not 60640020"):
        set_up_of(drives).run(drives)
