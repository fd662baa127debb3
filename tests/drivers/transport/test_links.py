"""Serial lines, TCP, UDP and bare descriptors as links carry bytes both ways and report losses and refusals."""

from __future__ import annotations

import fcntl
import os
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from drivers.emulators.ports import PtyPort, TcpPort, UdpPort
from drivers.transport.fd_link import SELECT_MOST, FdLink
from drivers.transport.link import Link, LinkLost, NoAnswer, drain, drain_until_quiet, now_s
from drivers.transport.serial_link import open_serial, port_owner
from drivers.transport.socket_link import open_tcp, open_udp
from hal.errors import DeviceUnavailable
from tests.drivers.rigs import later


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


def test_descriptors_beyond_those_that_select_knows_are_read_too() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        high = fcntl.fcntl(ours.fileno(), fcntl.F_DUPFD, SELECT_MOST)
        os.set_blocking(high, False)
        with closing(FdLink(high, "high")) as link:
            assert link.read(later(0.01)) == b""
            theirs.sendall(b"news")
            assert link.read(later(5.0)) == b"news"
            with pytest.raises(NoAnswer, match="accepts no more bytes"):
                link.write(bytes(1 << 24), later(0.01))
