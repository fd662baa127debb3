"""The stop latch starts latched, is latched if damaged, and is cleared only by a reset that saw the newest stop."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
import threading
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from service.processes.latch import BACK, BODY, BODY_AT, CLEAR, FULL_SPEED, HELD, REST, SIZE, SPEED_AT, Latch, StopLevel
from service.processes.stop import StopServer, obey


def test_a_new_latch_is_latched(tmp_path: Path) -> None:
    assert Latch.create(tmp_path / "latch").is_set()


def test_a_reset_clears_and_a_stop_latches_again(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    assert latch.reset("test", seen_count=latch.state().count)
    assert not latch.is_set()
    latch.set("button")
    assert latch.is_set()
    assert latch.state().source == "button"


def test_two_mappings_of_one_file_see_each_other(tmp_path: Path) -> None:
    writer = Latch.create(tmp_path / "latch")
    reader = Latch(tmp_path / "latch")
    writer.reset("test", seen_count=writer.state().count)
    assert not reader.is_set()
    writer.set("x")
    assert reader.is_set()


def test_a_closed_latch_counts_as_latched(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    latch.close()
    assert latch.is_set()
    assert latch.state().is_latched


@given(flag=st.integers(0, 255))
def test_every_byte_but_one_means_latched(tmp_path_factory: pytest.TempPathFactory, flag: int) -> None:
    path = tmp_path_factory.mktemp("latch") / "latch"
    memory = bytearray(SIZE)
    memory[BODY_AT] = flag
    path.write_bytes(bytes(memory))
    assert Latch(path).is_set() == (flag != CLEAR)


def test_a_writer_that_died_in_the_middle_reads_as_latched(tmp_path: Path) -> None:
    path = tmp_path / "latch"
    latch = Latch.create(path)
    latch.reset("test", seen_count=latch.state().count)
    torn = bytearray(path.read_bytes())
    torn[0] |= 1  # an odd sequence means that the record was being written
    path.write_bytes(bytes(torn))
    assert Latch(path).state().is_latched


def test_a_long_or_broken_source_is_cut_not_refused(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    assert latch.set("ü" * 500).is_latched
    assert latch.set("\ud800").is_latched


def test_stops_of_several_threads_are_all_counted(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    before = latch.state().count
    threads = [threading.Thread(target=lambda: [latch.set("press") for _ in range(500)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert latch.state().count == before + 2000


def test_readers_never_see_a_mixed_record(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    end = threading.Event()

    def write() -> None:
        while not end.is_set():
            count = latch.set("a" * 79).count
            latch.reset("b" * 79, seen_count=count)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        for _ in range(3000):
            state = Latch(tmp_path / "latch").state()
            assert state.source in ("a" * 79, "b" * 79, "latch not readable", "start: latched until an explicit reset")
            if state.source[0] == "b":
                assert not state.is_latched
    finally:
        end.set()
        writer.join()


@pytest.mark.parametrize("first", StopLevel)
@pytest.mark.parametrize("second", StopLevel)
def test_a_stop_replaces_a_weaker_one_and_never_weakens_one(
    tmp_path: Path, first: StopLevel, second: StopLevel
) -> None:
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    assert not any(latch.has(level) for level in StopLevel)
    latch.set("first", first)
    strength = [StopLevel.RETREAT, StopLevel.HOLD, StopLevel.OFF]
    assert [latch.has(level) for level in strength] == [n <= strength.index(first) for n in range(3)]
    held = max(first, second, key=strength.index)
    assert latch.set("second", second).level is held
    assert (latch.keeps_power(), latch.goes_back()) == (held is StopLevel.HOLD, held is StopLevel.RETREAT)


def test_a_damaged_or_closed_latch_keeps_no_power_and_lets_no_arm_go_back(tmp_path: Path) -> None:
    path = tmp_path / "latch"
    latch = Latch.create(path)
    memory = bytearray(path.read_bytes())
    memory[BODY_AT] = 0
    path.write_bytes(bytes(memory))
    for level in StopLevel:
        assert Latch(path).set("later", level).level is StopLevel.OFF
    assert latch.has(StopLevel.OFF)
    latch.close()
    assert latch.has(StopLevel.OFF) and not latch.keeps_power() and not latch.goes_back()


def test_the_flag_is_written_as_one_byte_and_never_with_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`struct` clears all of its bytes first: a reader would take a stop that holds for one that switches off."""
    written: list[range] = []

    class Noted:
        def __init__(self, layout: struct.Struct) -> None:
            self._layout, self.unpack_from = layout, layout.unpack_from

        def pack_into(self, memory: Any, at: int, *values: Any) -> None:
            written.append(range(at, at + self._layout.size))
            self._layout.pack_into(memory, at, *values)

    monkeypatch.setattr("service.processes.latch.BODY", Noted(BODY))
    monkeypatch.setattr("service.processes.latch.REST", Noted(REST))
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.set("hold", StopLevel.HOLD).count)
    assert len(written) == 3 and not any(BODY_AT in part for part in written)


class LatchLife(RuleBasedStateMachine):
    """Stops and resets in any order, compared with a simple model."""

    def __init__(self) -> None:
        super().__init__()
        import tempfile

        self.folder = tempfile.TemporaryDirectory()
        self.latch = Latch.create(Path(self.folder.name) / "latch")
        self.is_latched = True
        self.seen = self.latch.state().count

    @rule(source=st.text(max_size=100))
    def stop(self, source: str) -> None:
        self.latch.set(source)
        self.is_latched = True

    @rule()
    def look(self) -> None:
        self.seen = self.latch.state().count

    @rule()
    def reset(self) -> None:
        is_newest = self.seen == self.latch.state().count
        assert self.latch.reset("test", seen_count=self.seen) == is_newest
        if is_newest:
            self.is_latched = False

    @invariant()
    def agrees_with_the_model(self) -> None:
        assert self.latch.is_set() == self.is_latched == self.latch.state().is_latched

    def teardown(self) -> None:
        self.latch.close()
        self.folder.cleanup()


TestLatchLife = LatchLife.TestCase


def _answer(tmp_path: Path, request: str, origins: tuple[str, ...] = ()) -> tuple[int, dict[str, object], str, Latch]:
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    server, head_bytes = StopServer(latch, origins), request.encode("latin-1")
    state = server.begin(head_bytes.partition(b"\n")[0], "127.0.0.1")
    text = server.answer(head_bytes, state).decode()
    head, _, body = text.partition("\r\n\r\n")
    return int(head.split()[1]), json.loads(body or "{}"), head, latch


def test_post_stops_whatever_else_the_request_says(tmp_path: Path) -> None:
    request = "POST /v1/stop?x=1 HTTP/1.1\r\nHost: evil\r\nOrigin: http://evil\r\nbroken header\r\n\r\n"
    status, body, head, latch = _answer(tmp_path, request)
    assert (status, body["is_latched"], latch.is_set()) == (200, True, True)
    assert "Access-Control" not in head, "a stranger's page may stop, but not read"


def test_only_our_own_page_may_read_the_answer(tmp_path: Path) -> None:
    request = "GET /v1/stop HTTP/1.1\r\nOrigin: http://127.0.0.1:8460\r\n\r\n"
    assert "Access-Control-Allow-Origin" in _answer(tmp_path, request, ("http://127.0.0.1:8460",))[2]


@pytest.mark.parametrize(
    ("request_line", "status"),
    [("GET /v1/stop", 200), ("OPTIONS /v1/stop", 204), ("PUT /v1/stop", 405), ("POST /", 404), ("\0\xff", 404)],
)
def test_nothing_but_post_stops(tmp_path: Path, request_line: str, status: int) -> None:
    found, _, _, latch = _answer(tmp_path, f"{request_line} HTTP/1.1\r\n\r\n")
    assert found == status
    assert not latch.is_set()


def test_the_supervisors_lines_stop_and_reset(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    obey(latch, f"reset {latch.state().count} the supervisor\n")
    assert not latch.is_set()
    obey(latch, "stop a good reason\n")
    assert latch.state().source == "a good reason"
    obey(latch, "reset 0 too late\n")
    assert latch.is_set()


def test_a_damaged_or_closed_latch_switches_off_and_makes_the_arm_slow(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    obey(latch, f"reset {latch.state().count} the supervisor\n")
    assert not latch.is_reduced()
    obey(latch, "hold a good reason\n")
    assert (latch.is_set(), latch.keeps_power(), latch.state().level) == (True, True, StopLevel.HOLD)
    for byte in {*range(256)} - {BACK, HELD, CLEAR}:
        latch._memory[BODY_AT] = byte
        assert latch.is_set() and not latch.keeps_power()
        latch.set("a person", StopLevel.HOLD)
        assert not latch.keeps_power(), "a stop that switches off is never made weaker"
    for byte in {*range(256)} - {FULL_SPEED}:
        latch._memory[SPEED_AT] = byte
        assert latch.is_reduced()
    latch.close()
    assert latch.is_set() and not latch.keeps_power() and latch.is_reduced()


def test_slow_and_broken_clients_hold_nobody_up(tmp_path: Path) -> None:
    """A stop is still answered with hundreds of half-open connections."""
    latch = Latch.create(tmp_path / "latch")

    async def scene() -> bytes:
        listener = socket.socket()
        listener.bind(("127.0.0.1", 0))
        server = await StopServer(latch).start(listener)
        port = listener.getsockname()[1]
        idle = [await asyncio.open_connection("127.0.0.1", port) for _ in range(200)]
        for _, writer in idle:
            writer.write(b"POST /v1/st")
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"POST /v1/stop HTTP/1.1\r\n\r\n")
        answer = await reader.read()
        for _, open_writer in [*idle, (reader, writer)]:
            open_writer.close()
        server.close()
        return answer

    assert asyncio.run(scene()).startswith(b"HTTP/1.1 200")
    assert "POST /v1/stop" in latch.state().source


def test_a_strange_host_or_page_may_stop_and_is_told_nothing_else(tmp_path: Path) -> None:
    own = ("http://127.0.0.1:8460",)
    for stranger in ("Host: evil.example", "Host: 127.0.0.1:8461\r\nOrigin: http://127.0.0.1:3000"):
        status, body, _, latch = _answer(tmp_path, f"POST /v1/stop HTTP/1.1\r\n{stranger}\r\n\r\n", own)
        assert (status, body, latch.is_set()) == (200, {"is_latched": True}, True)
        status, body, head, _ = _answer(tmp_path, f"GET /v1/stop HTTP/1.1\r\n{stranger}\r\n\r\n", own)
        assert (status, "Access-Control" in head) == (403, False)
        assert "source" not in body and "is_latched" not in body
    status, body, head, _ = _answer(tmp_path, f"GET /v1/stop HTTP/1.1\r\nOrigin: {own[0]}\r\n\r\n", own)
    assert (status, "count" in body) == (200, True)


def test_a_page_of_any_origin_that_asks_first_may_stop(tmp_path: Path) -> None:
    request = "OPTIONS /v1/stop HTTP/1.1\r\nOrigin: http://evil\r\nAccess-Control-Request-Headers: x\r\n\r\n"
    status, _, head, latch = _answer(tmp_path, request)
    assert (status, latch.is_set()) == (204, False)
    assert "Access-Control-Allow-Methods: POST\r\n" in head


async def _talk(latch: Latch, *parts: bytes, is_complete: bool) -> bytes:
    """Send parts to a stop server; return its answer, or nothing when the stop is latched and none is awaited."""
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    server = await StopServer(latch).start(listener)
    reader, writer = await asyncio.open_connection("127.0.0.1", listener.getsockname()[1])
    for part in parts:
        writer.write(part)
        await writer.drain()
    answer = b""
    if is_complete:
        answer = await reader.read()
    else:
        pause = asyncio.Event()
        while not latch.is_set():
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(pause.wait(), 0.005)
    writer.close()
    server.close()
    return answer


def test_a_stop_with_60_kb_of_cookies_stops_and_is_answered(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    cookies = b"".join(b"Cookie: " + b"x" * 3000 + b"\r\n" for _ in range(20))
    request = b"POST /v1/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n" + cookies + b"\r\n"
    answer = asyncio.run(_talk(latch, request, is_complete=True))
    assert answer.startswith(b"HTTP/1.1 200") and latch.is_set()


def test_a_request_line_stops_although_the_rest_of_its_head_never_comes(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    latch.reset("test", seen_count=latch.state().count)
    asyncio.run(asyncio.wait_for(_talk(latch, b"POST /v1/stop HTTP/1.1\r\nHost: 12", is_complete=False), 30.0))
    assert latch.is_set()


def test_the_answer_to_a_stop_says_whether_it_is_recorded(tmp_path: Path) -> None:
    latch = Latch.create(tmp_path / "latch")
    request = b"POST /v1/stop HTTP/1.1\r\n\r\n"
    assert b'"is_recorded": false' in asyncio.run(_talk(latch, request, is_complete=True)), "nobody records it here"
    latch.note_recorded(latch.state().count + 1)
    assert b'"is_recorded": true' in asyncio.run(_talk(latch, request, is_complete=True))


@pytest.mark.parametrize("head", [b"", b"GET /v1/stop HTTP/1.1\r\nHost: 127", b"POST /v1/stop HTTP/1.1\r\nHost: 127"])
def test_of_connections_that_come_at_once_and_never_end_no_more_are_kept_than_there_are_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, head: bytes
) -> None:
    monkeypatch.setattr("service.processes.stop.MAX_CONNECTIONS", 20)
    monkeypatch.setattr("service.processes.stop.HEAD_TIMEOUT_S", 600.0)
    latch = Latch.create(tmp_path / "latch")

    async def scene() -> bytes:
        listener = socket.create_server(("127.0.0.1", 0), backlog=512)
        address = listener.getsockname()
        crowd = [socket.create_connection(address) for _ in range(100)]  # all are accepted in one turn of the loop
        for one in crowd:
            one.sendall(head)
            one.setblocking(False)
        server = await StopServer(latch).start(listener)
        loop = asyncio.get_running_loop()
        ends = [asyncio.ensure_future(_ended(loop, one)) for one in crowd]
        while sum(end.done() for end in ends) < 80:
            await asyncio.wait([end for end in ends if not end.done()], return_when=asyncio.FIRST_COMPLETED)
        reader, writer = await asyncio.open_connection(*address)
        writer.write(b"POST /v1/stop HTTP/1.1\r\n\r\n")
        answer = await reader.read()
        writer.close()
        for end, one in zip(ends, crowd, strict=True):
            end.cancel()
            one.close()
        server.close()
        return answer

    assert asyncio.run(asyncio.wait_for(scene(), 120.0)).startswith(b"HTTP/1.1 200")


async def _ended(loop: asyncio.AbstractEventLoop, link: socket.socket) -> None:
    with contextlib.suppress(OSError):
        while await loop.sock_recv(link, 4000):
            pass
