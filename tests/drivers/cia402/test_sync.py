"""PDOs are assigned to SYNCs by counting; late, lost, repeated and stray PDOs are never taken for the newest."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402.setup import CONSUMER, MAPPINGS, SdoClient, SetUp
from drivers.cia402.sync import PDOS, PROBE_S, SyncCount
from drivers.transport.can_frames import CanFrame, record, records
from drivers.transport.link import NoAnswer, Refused
from tests.drivers.rigs import ScriptLink

PERIOD_S = 0.01
Fate = int | None


def as_data(number: int, pdo: int) -> bytes:
    return struct.pack("<IB", number, pdo)


class Wire:
    """Frames of one drive in transit: each is late by some periods and delays later ones, or is lost, or sent twice."""

    def __init__(self, fates: list[Fate], twice: list[bool], *, sdo_later: int) -> None:
        self._fates, self._twice = itertools.cycle(fates), itertools.cycle(twice)
        self._free_at, self._sdo_later = 0, sdo_later
        self._frames: list[tuple[int, int, bytes | None, int]] = []  # (period of arrival, order, PDO or probe, which)
        self._order = itertools.count()

    def put(self, period: int, data: bytes | None, which: int) -> None:
        for _ in range(1 + next(self._twice)):
            later = next(self._fates)
            if later is not None:
                self._free_at = max(self._free_at, period + later)
                arrival = self._free_at + (self._sdo_later if data is None else 0)
                self._frames.append((arrival, next(self._order), data, which))

    def take(self, period: int) -> list[tuple[bytes | None, int]]:
        arrived = sorted(frame for frame in self._frames if frame[0] <= period)
        self._frames = [frame for frame in self._frames if frame[0] > period]
        return [(data, which) for _, _, data, which in arrived]


@given(
    st.lists(st.sampled_from([0, 0, 0, 1, 2, 5, None]), min_size=5, max_size=60),
    st.lists(st.sampled_from([False, False, True]), min_size=1, max_size=30),
    st.sampled_from([1, 1000]),
)
def test_each_pdo_is_of_the_sync_that_it_is_said_to_be_of_on_a_drive_that_keeps_order(
    fates: list[Fate], twice: list[bool], standing_for: int
) -> None:
    """The position changes every `standing_for` SYNCs: every time if the arm moves, never if it stands."""
    count, wire, newest = SyncCount(), Wire(fates, twice, sdo_later=0), [0] * PDOS
    for number in range(1, 80):
        if count.wants_probe(number * PERIOD_S):
            count.probed(number * PERIOD_S)
            wire.put(number, None, count.probes)
        count.synced()
        for pdo in range(PDOS):
            wire.put(number, as_data(number // standing_for, pdo), pdo)
        for data, which in wire.take(number):
            if data is not None and count.took(which, data):
                newest[which] = struct.unpack("<IB", data)[0]
            elif data is None and which == count.probes:  # an answer to an older probe names another object
                count.probe_answered()
            if count.answered is not None:
                assert newest == [count.answered // standing_for] * PDOS


@pytest.mark.parametrize("sdo_later", [0, 1, 3])
@pytest.mark.parametrize("standing_for", [1, 1000])
def test_after_repeats_losses_and_delays_each_sync_is_answered_again(sdo_later: int, standing_for: int) -> None:
    """The drive answers SDOs in order or, if it is busy, after later PDOs; the arm moves or stands."""
    fates: list[Fate] = [0] * 20 + [2, None, 0, 0, 1, None] + [0] * 7 + [None, 0]
    count, number, answered = SyncCount(), 0, []
    bad, good = Wire(fates, [False, False, True], sdo_later=sdo_later), Wire([0], [False], sdo_later=sdo_later)
    for period in range(1, 200):
        wire = bad if period < 150 else good
        if count.wants_probe(period * PERIOD_S):
            count.probed(period * PERIOD_S)
            wire.put(period, None, count.probes)
        if not count.needs_rest:
            number += 1
            count.synced()
            for pdo in range(PDOS):
                wire.put(period, as_data(number // standing_for, pdo), pdo)
        for data, which in [*bad.take(period), *good.take(period)]:
            if data is not None:
                count.took(which, data)
            elif which == count.probes:
                count.probe_answered()
        answered.append(count.answered == number)
    assert all(answered[180:])
    assert any(answered[:140])


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
            count.probe_answered()  # comes before the PDOs of the next SYNC, because the probe was sent before it
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


def test_of_two_that_are_owed_a_repeated_one_answers_one() -> None:
    count = SyncCount()
    count.synced()
    count.synced()
    for pdo in range(PDOS):
        assert count.took(pdo, as_data(1, pdo))
        assert not count.took(pdo, as_data(1, pdo))
        assert count.answered is None, "the second SYNC has not been answered"
    for pdo in range(PDOS):
        assert count.took(pdo, as_data(2, pdo))
    assert count.answered == 2


def test_a_drive_whose_pdos_overtake_its_sdo_answers_is_given_rest_when_one_was_lost() -> None:
    count = SyncCount()
    assert count.wants_probe(0.0), "the first one finds out"
    count.probed(0.0)
    count.synced()
    for pdo in range(PDOS):
        count.took(pdo, as_data(1, pdo))
    count.probe_answered()
    assert count.answered == 1
    assert not count.needs_rest
    count.synced()
    count.took(1, as_data(2, 1))
    assert count.needs_rest
    assert count.wants_probe(1.0)
    count.probed(1.0)
    count.probe_answered()
    assert not count.needs_rest
    count.synced()
    for pdo in range(PDOS):
        count.took(pdo, as_data(3, pdo))
    assert count.answered == 3


def test_a_lost_probe_is_asked_again() -> None:
    count = SyncCount()
    count.synced()
    assert count.wants_probe(0.0)
    count.probed(0.0)
    assert not count.wants_probe(0.5 * PROBE_S)
    assert count.wants_probe(1.5 * PROBE_S)


class Drives:
    """Objects of two drives; the link is lost before each transfer whose number is in `breaks`."""

    def __init__(self, breaks: set[int]) -> None:
        self.objects = {
            node: {(index, sub + 1): value for index in MAPPINGS for sub, value in enumerate(MAPPINGS[index])}
            for node in (1, 2)
        }
        self.transfers = 0
        self.at_transfer: Callable[[], None] = lambda: None
        self._breaks = breaks

    def _count(self) -> None:
        self.transfers += 1
        self.at_transfer()
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


def test_a_drive_that_restarts_while_another_is_set_up_is_set_up_again() -> None:
    drives = Drives(breaks=set())
    set_up = set_up_of(drives)

    def restart() -> None:
        if drives.transfers == 10:
            drives.objects[1].pop((CONSUMER, 1))
            set_up.forget(1)

    drives.at_transfer = restart
    set_up.run(drives)
    assert drives.objects[1][CONSUMER, 1] == 0x7F0064


class SdoLine(ScriptLink):
    """slcan link whose other end answers each request with some frames."""

    def __init__(self, *frames: list[CanFrame]) -> None:
        super().__init__(*(b"".join(map(record, answer)) for answer in frames))


def test_an_upload_in_segments_is_put_together() -> None:
    link = SdoLine(
        [CanFrame(0x581, bytes.fromhex("4100160104000000"))],
        [CanFrame(0x581, bytes.fromhex("0810007a00000000"))],  # three bytes, more to come
        [CanFrame(0x581, bytes.fromhex("1d60000000000000"))],  # one byte, the last
    )
    assert SdoClient(link).upload(1, 0x1600, 1) == 0x607A0010
    assert [data[0] for line in link.written for _, data, _ in records(line)] == [0x40, 0x60, 0x70]


def test_a_boot_up_between_sdo_answers_is_told() -> None:
    restarted: list[int] = []
    link = SdoLine([CanFrame(0x702, b"\0"), CanFrame(0x581, bytes.fromhex("4b17100032000000"))])
    assert SdoClient(link, restarted=restarted.append).upload(1, 0x1017, 0) == 50
    assert restarted == [2]


def test_a_drive_that_maps_other_objects_is_refused() -> None:
    drives = Drives(breaks=set())
    drives.objects[2][0x1A00, 2] = 0x606C0020
    with pytest.raises(Refused, match=r"node 2: object 1A00h:2 maps 606C0020, not 60640020"):
        set_up_of(drives).run(drives)
