"""Links, ports, mailboxes and Modbus masters by themselves."""

import fcntl
import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import psutil
import pytest

from drivers.emulators.ports import PtyPort, TcpPort, UdpPort
from drivers.transport.checks import crc_modbus
from drivers.transport.fd_link import SELECT_MOST, FdLink
from drivers.transport.link import (
    Link,
    LinkLost,
    NoAnswer,
    Refused,
    drain,
    drain_until_quiet,
    now_s,
)
from drivers.transport.mailbox import Mailbox
from drivers.transport.modbus import ModbusRtu, ModbusTcp
from drivers.transport.port import Port
from drivers.transport.serial_link import open_serial, port_owner
from drivers.transport.socket_link import open_tcp, open_udp
from hal.errors import CellError, DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.readings import Stamped
from tests.drivers.rigs import until


def later(duration_s: float = 1.0) -> float:
    return now_s() + duration_s


class ScriptLink:
    """A link whose far side is a list: each write moves the next answer into the receive buffer."""

    name = "script"
    byte_s = 0.0

    def __init__(self, *answers: bytes) -> None:
        self.answers = list(answers)
        self.written: list[bytes] = []
        self.ready = b""

    def read(self, until_s: float) -> bytes:
        chunk, self.ready = self.ready, b""
        return chunk

    def write(self, data: bytes, until_s: float) -> None:
        self.written.append(data)
        self.ready += self.answers.pop(0) if self.answers else b""

    def is_present(self) -> bool:
        return True

    def close(self) -> None:
        self.ready = b""


def rtu(body: str) -> bytes:
    data = bytes.fromhex(body)
    return data + crc_modbus(data).to_bytes(2, "little")


@pytest.fixture
def pty_port() -> Iterator[PtyPort]:
    with closing(PtyPort("line")) as port:
        yield port


def test_bytes_cross_a_serial_line_both_ways(pty_port: PtyPort) -> None:
    with closing(open_serial(str(pty_port.path), baud=9600, device="d")) as link:
        link.write(b"ask", later())
        assert pty_port.receive(1.0) == [(None, b"ask")]
        pty_port.send(None, b"answer")
        assert link.read(later()) == b"answer"
        assert link.read(now_s()) == b""


def test_a_line_that_hangs_up_is_lost_for_reads_and_writes(pty_port: PtyPort) -> None:
    with closing(open_serial(str(pty_port.path), baud=9600, device="d")) as link:
        pty_port.vanish()
        with pytest.raises(LinkLost):
            link.read(later())
        with pytest.raises(LinkLost):
            link.write(b"x", later())
        assert not link.is_present()


def test_a_name_that_leads_to_another_port_is_noticed(pty_port: PtyPort) -> None:
    with closing(open_serial(str(pty_port.path), baud=9600, device="d")) as link:
        assert link.is_present()
        with closing(PtyPort("other")) as other:
            pty_port.path.unlink()
            pty_port.path.symlink_to(other.path.resolve())
            assert not link.is_present()


def test_the_owner_of_a_taken_port_is_named(pty_port: PtyPort) -> None:
    with closing(open_serial(str(pty_port.path), baud=9600, device="first")):
        assert f"pid {os.getpid()}" in (port_owner(str(pty_port.path)) or "")
        with pytest.raises(DeviceUnavailable, match=r"second: port .* is taken by"):
            open_serial(str(pty_port.path), baud=9600, device="second")


def test_a_file_is_no_serial_port(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.touch()
    with pytest.raises(DeviceUnavailable, match="cannot be opened"):
        open_serial(str(path), baud=9600, device="d")


def test_tcp_says_who_refuses() -> None:
    with closing(socket.socket()) as nobody:
        nobody.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceUnavailable, match="refuses"):
            open_tcp("127.0.0.1", nobody.getsockname()[1], timeout_s=0.5, device="d")


def test_tcp_that_hangs_up_is_lost() -> None:
    with closing(TcpPort()) as far, closing(_tcp(far)) as link:
        far.receive(1.0)
        far.vanish()
        with pytest.raises(LinkLost):
            link.read(later())


def _tcp(far: TcpPort) -> Link:
    return open_tcp("127.0.0.1", far.address["port"], timeout_s=1.0, device="d")


def test_udp_keeps_datagrams_apart_and_strangers_out() -> None:
    with closing(UdpPort()) as far, closing(open_udp("127.0.0.1", far.address["port"], device="d")) as link:
        link.write(b"hello", later())
        ((peer, data),) = far.receive(1.0)
        assert data == b"hello"
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as stranger:
            stranger.sendto(b"lie", peer)
        far.send(peer, b"one")
        far.send(peer, b"two")
        assert [link.read(later()), link.read(later())] == [b"one", b"two"]


def test_a_write_that_nobody_takes_ends_in_time() -> None:
    with closing(TcpPort()) as far, closing(_tcp(far)) as link, pytest.raises(NoAnswer):
        link.write(bytes(50_000_000), later(0.05))


def test_draining_ends_when_the_line_is_quiet_and_in_any_case(pty_port: PtyPort) -> None:
    with closing(open_serial(str(pty_port.path), baud=9600, device="d")) as link:
        pty_port.send(None, bytes(100))
        assert drain_until_quiet(link, quiet_s=0.02, until_s=later()) == 100
        assert drain(link) == b""


def test_the_mailbox_gives_the_newest_and_counts_what_a_slow_reader_lost() -> None:
    box: Mailbox[int] = Mailbox(ring=4)
    for i in range(1, 11):
        box.publish(Stamped(value=i, host_time_s=float(i), sequence=i))
    assert box.wait(oldest_host_s=0.0, until_s=now_s()) is box.peek()
    fresh, lost = box.since(2)
    assert [sample.value for sample in fresh] == [7, 8, 9, 10]
    assert lost == 4
    assert box.wait(oldest_host_s=11.0, until_s=now_s()) is None


def test_an_error_reaches_all_readers_until_the_next_sample() -> None:
    box: Mailbox[int] = Mailbox()
    box.fail(DeviceFault("broken", hint="mend it"))
    for _ in range(2):
        with pytest.raises(DeviceFault, match="broken"):
            box.wait(oldest_host_s=0.0, until_s=later())
    box.publish(Stamped(value=1, host_time_s=1.0, sequence=1))
    assert box.wait(oldest_host_s=0.0, until_s=later()) is not None


def test_silence_is_the_answer_only_when_the_readers_time_is_over() -> None:
    box: Mailbox[int] = Mailbox()
    box.fail(DeviceTimeout("silent for 0.3 s", hint="check power"))
    with pytest.raises(DeviceTimeout, match="silent"):
        box.wait(oldest_host_s=0.0, until_s=now_s())
    got: list[Stamped[int] | None] = []
    reader = threading.Thread(target=lambda: got.append(box.wait(oldest_host_s=0.0, until_s=later(5.0))))
    reader.start()
    box.publish(Stamped(value=3, host_time_s=1.0, sequence=1))
    reader.join(5.0)
    assert got[0] is not None and got[0].value == 3


def test_a_waiting_reader_wakes_with_the_sample() -> None:
    box: Mailbox[int] = Mailbox()
    got: list[Stamped[int] | None] = []
    reader = threading.Thread(target=lambda: got.append(box.wait(oldest_host_s=0.0, until_s=later(5.0))))
    reader.start()
    box.publish(Stamped(value=7, host_time_s=1.0, sequence=1))
    reader.join(5.0)
    assert got[0] is not None and got[0].value == 7


@pytest.fixture
def busy_switching() -> Iterator[None]:
    """The interpreter changes threads after nearly every instruction, so that no gap between two of them stays hidden."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-7)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("busy_switching")
def test_no_reader_misses_its_waking_and_none_gets_a_sample_twice() -> None:
    """Writer and readers in lock step: each sample is published only when every reader waits for it or is about to."""
    box: Mailbox[int] = Mailbox()
    rounds, readers = 1000, 3
    got: list[list[int]] = [[] for _ in range(readers)]
    has_all = threading.Barrier(readers + 1)

    def read(mine: list[int]) -> None:
        for i in range(1, rounds + 1):
            sample = box.wait(oldest_host_s=float(i), until_s=later(60.0))
            mine.append(0 if sample is None else sample.value)
            has_all.wait(60.0)

    threads = [threading.Thread(target=read, args=(mine,), daemon=True) for mine in got]
    for thread in threads:
        thread.start()
    for i in range(1, rounds + 1):
        box.publish(Stamped(value=i, host_time_s=float(i), sequence=i))
        has_all.wait(30.0)  # a lost waking leaves its reader waiting for 60 s, and breaks the barrier
    assert got == [list(range(1, rounds + 1))] * readers


@pytest.mark.usefixtures("busy_switching")
def test_every_sample_reaches_a_hurried_reader_once_or_is_counted_as_lost() -> None:
    box: Mailbox[int] = Mailbox(ring=8)
    most = 20_000
    writer = threading.Thread(
        target=lambda: [box.publish(Stamped(value=i, host_time_s=float(i), sequence=i)) for i in range(1, most + 1)]
    )
    seen, lost, last = list[int](), 0, 0
    writer.start()
    while last < most:
        fresh, missed = box.since(last)
        seen += [sample.sequence for sample in fresh]
        lost, last = lost + missed, seen[-1] if seen else 0
    writer.join(5.0)
    assert seen == sorted(set(seen))
    assert len(seen) + lost == most


def test_news_that_comes_between_a_readers_look_and_its_wait_is_not_missed() -> None:
    class NewsComesLate(Mailbox[int]):
        def peek(self) -> Stamped[int] | None:
            seen = super().peek()
            if seen is None:
                self.publish(Stamped(value=5, host_time_s=1.0, sequence=1))
            return seen

    box, got = NewsComesLate(), list[Stamped[int] | None]()
    reader = threading.Thread(target=lambda: got.append(box.wait(oldest_host_s=0.0, until_s=later(60.0))), daemon=True)
    reader.start()
    reader.join(30.0)
    assert [sample.value for sample in got if sample] == [5]


def test_a_failure_wakes_all_readers() -> None:
    box: Mailbox[int] = Mailbox()
    errors: list[CellError] = []

    def read() -> None:
        try:
            box.wait(oldest_host_s=0.0, until_s=later(60.0))
        except CellError as error:
            errors.append(error)

    threads = [threading.Thread(target=read, daemon=True) for _ in range(3)]
    for thread in threads:
        thread.start()
    box.fail(DeviceFault("broken", hint="mend it"))
    for thread in threads:
        thread.join(30.0)
    assert [error.what for error in errors] == ["broken"] * 3
    assert len({id(error) for error in errors}) == 3, "each has its own traceback"


def test_a_device_that_was_slow_to_every_question_is_not_believed_until_it_has_finished() -> None:
    stale, fresh = rtu("09 04 02 00 01"), rtu("09 04 02 00 02")
    link = ScriptLink()
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.01)
    while {written[1] for written in link.written} != {1, 2, 3, 4}:
        with pytest.raises(NoAnswer):
            master.read_registers(unit=9, address=0, count=1, until_s=later(0.05), function=4)
    link.answers = [stale, fresh]
    assert master.read_registers(unit=9, address=0, count=1, until_s=later(), function=4) == (2,)
    assert master.late_bytes >= len(stale)


class Tenant:
    """Counts its calls; serves until told to lose the link."""

    def __init__(self) -> None:
        self.set_ups = 0
        self.losses: list[str] = []
        self.lose = threading.Event()

    def set_up(self, link: Link) -> None:
        self.set_ups += 1

    def serve(self, link: Link) -> None:
        if self.lose.is_set():
            self.lose.clear()
            raise LinkLost("gone")
        link.read(later(0.005))

    def lost(self, error: Exception) -> None:
        self.losses.append(str(error))


def test_a_port_repeats_the_set_up_after_each_loss_without_a_leak() -> None:
    far = PtyPort("line")
    tenant = Tenant()
    port = Port("p", open_link=lambda: open_serial(str(far.path), baud=9600, device="p"), tenant=tenant)
    process = psutil.Process()
    try:
        port.start()
        until(lambda: port.link is not None)
        before = (process.num_fds(), threading.active_count())
        for i in range(20):
            tenant.lose.set()
            until(lambda i=i: tenant.set_ups == i + 2)
        until(lambda: port.link is not None)
        assert (process.num_fds(), threading.active_count()) == before
        assert port.reconnects == 20
        assert tenant.losses == ["gone"] * 20
    finally:
        port.close()
        port.close()
        far.close()


@pytest.mark.parametrize("is_allowed", [True, False])
def test_an_owner_thread_asks_for_real_time_and_lives_without(
    is_allowed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[str, int]] = []

    def schedule(pid: int, policy: int, param: os.sched_param) -> None:
        assert (pid, policy) == (0, os.SCHED_RR | os.SCHED_RESET_ON_FORK)
        asked.append((threading.current_thread().name, param.sched_priority))
        if not is_allowed:
            raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", schedule)
    port = Port("p", open_link=ScriptLink, tenant=Tenant(), realtime_priority=7)
    port.start()
    until(lambda: port.link is not None)
    port.close()
    assert asked == [("port p", 7)]
    assert port.is_realtime is is_allowed


def test_descriptors_beyond_those_that_select_knows_are_read_too() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        high = fcntl.fcntl(ours.fileno(), fcntl.F_DUPFD, SELECT_MOST)
        os.set_blocking(high, False)
        with closing(FdLink(high, "high")) as link:
            assert link.read(later(0.01)) == b""
            theirs.sendall(b"news")
            assert link.read(later(5.0)) == b"news"


def test_rtu_takes_an_answer_among_noise_echo_and_a_false_header() -> None:
    ask = rtu("0903 07d0 0003")
    answer = rtu("0903 06 3900 00ff 0e0a")
    link = ScriptLink(ask + b"\x09\x03\x06\x00" + answer)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    registers = master.read_registers(unit=9, address=0x7D0, count=3, until_s=later())
    assert registers == (0x3900, 0x00FF, 0x0E0A)
    assert link.written == [ask]


def test_rtu_never_takes_a_late_answer_for_the_next() -> None:
    old, young = rtu("0902 01 55"), rtu("0902 01 aa")
    probe = rtu("0983 02")  # exception of the function that is asked in between
    link = ScriptLink(b"", old + probe, young)
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0, quarantine_s=0.0)
    with pytest.raises(NoAnswer):
        master.read_bits(unit=9, address=0, count=8, until_s=later(0.0))
    bits = master.read_bits(unit=9, address=0, count=8, until_s=later())
    assert sum(1 << i for i, bit in enumerate(bits) if bit) == 0xAA
    assert [frame[1] for frame in link.written] == [2, 3, 2]


def test_rtu_drops_what_lies_ready_before_it_asks() -> None:
    link = ScriptLink(rtu("0902 01 aa"))
    link.ready = rtu("0902 01 55")
    master = ModbusRtu(link, timeout_s=0.01, gap_s=0.0)
    assert master.read_bits(unit=9, address=0, count=2, until_s=later()) == (False, True)
    assert master.late_bytes == 6


def test_rtu_refuses_damaged_and_foreign_answers() -> None:
    for wrong in (b"\x09\x02\x01\xaa\x00\x00", rtu("0802 01 aa"), rtu("0902 02 aaaa"), rtu("0901 01 aa")):
        master = ModbusRtu(ScriptLink(wrong), timeout_s=0.01, gap_s=0.0)
        with pytest.raises(NoAnswer):
            master.read_bits(unit=9, address=0, count=8, until_s=later(0.0))


def test_tcp_matches_transaction_unit_and_function() -> None:
    late = bytes.fromhex("0009 0000 0004 01 02 01 55")
    good = bytes.fromhex("0001 0000 0004 01 02 01 aa")
    link = ScriptLink(late + good)
    master = ModbusTcp(link, timeout_s=0.01)
    bits = master.read_bits(unit=1, address=0, count=8, until_s=later())
    assert bits == tuple(bool(0xAA >> i & 1) for i in range(8))
    master = ModbusTcp(ScriptLink(late), timeout_s=0.01)
    with pytest.raises(NoAnswer, match="do not fit"):
        master.read_bits(unit=1, address=0, count=8, until_s=later(0.0))


def test_exceptions_say_what_they_mean() -> None:
    master = ModbusTcp(ScriptLink(bytes.fromhex("0001 0000 0003 01 81 02")), timeout_s=0.01)
    with pytest.raises(Refused, match="no such address") as caught:
        master.read_bits(unit=1, address=0, count=8, until_s=later(), function=1)
    assert caught.value.code == 2
