"""Objects in other processes behave like local ones."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hal.clock import Deadline, PacedClock, WallClock
from hal.errors import ConfigError, DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.host import ANSWER_MARGIN_S, HostServer, Proxy
from hal.host_process import HostProcess
from hal.isolated import isolated_device
from hal.readings import Stamped
from hal.registry import Context


class Calculator:
    """Object that is served by another process."""

    name = "calculator"

    def double(self, image: np.ndarray) -> Stamped[np.ndarray]:
        return Stamped(value=image * 2, host_time_s=1.5, sequence=3)

    def fail(self) -> None:
        raise DeviceFault("calculator overheats", hint="let it cool", device="calculator")

    def crash(self) -> None:
        raise ZeroDivisionError("oops")

    def remaining(self, *, deadline: Deadline) -> float:
        return deadline.remaining_s()

    def hang(self, *, deadline: Deadline) -> None:
        deadline.clock.sleep(30.0)

    def lock(self) -> object:
        return threading.Lock()

    def close(self) -> None:
        """Do nothing, because there is nothing to release."""


def make() -> dict[str, object]:
    return {"calculator": Calculator()}


def make_broken() -> dict[str, object]:
    raise DeviceUnavailable("no such port", hint="plug it in", device="calculator")


@pytest.fixture(scope="module")
def host() -> Iterator[HostProcess]:
    process = HostProcess(make)
    yield process
    process.close()


@pytest.mark.parametrize("size", [1, 100, 20_000, 640 * 480, 10])
def test_arrays_of_any_size_come_back_whole(host: HostProcess, size: int) -> None:
    image = np.arange(size, dtype=np.uint16)
    answer = host.proxy("calculator").double(image)
    assert (answer.host_time_s, answer.sequence) == (1.5, 3)
    np.testing.assert_array_equal(answer.value, image * 2)
    answer.value[0] = 7  # a received array belongs to the receiver


def test_typed_errors_come_back_as_themselves(host: HostProcess) -> None:
    with pytest.raises(DeviceFault, match="overheats") as caught:
        host.proxy("calculator").fail()
    assert caught.value.hint == "let it cool"
    assert caught.value.details == {"device": "calculator"}


def test_a_defect_over_there_is_a_defect_here(host: HostProcess) -> None:
    proxy = host.proxy("calculator")
    with pytest.raises(RuntimeError, match="ZeroDivisionError"):
        proxy.crash()
    assert proxy.double(np.ones(1)).value[0] == 2.0


def test_a_deadline_travels_as_the_time_that_is_left(host: HostProcess) -> None:
    left = host.proxy("calculator").remaining(deadline=Deadline.after(WallClock(), 5.0))
    assert 0.0 < left <= 5.0


def test_a_hung_object_is_a_timeout_and_the_next_call_is_answered(host: HostProcess) -> None:
    proxy = host.proxy("calculator")
    with pytest.raises(DeviceTimeout, match=r"calculator\.hang"):
        proxy.hang(deadline=Deadline.after(WallClock(), 0.01))
    assert proxy.double(np.ones(1)).value[0] == 2.0


def test_an_answer_that_cannot_travel_is_a_defect_and_the_host_lives(host: HostProcess) -> None:
    proxy = host.proxy("calculator")
    with pytest.raises(RuntimeError, match="cannot be sent to another process"):
        proxy.lock()
    assert proxy.double(np.ones(1)).value[0] == 2.0


def test_an_interrupted_call_does_not_leave_its_answer_to_the_next(host: HostProcess) -> None:
    class CtrlC(WallClock):
        """Clock that raises KeyboardInterrupt after the request was sent, when the wait for the answer begins."""

        asked = 0

        def now_s(self) -> float:
            self.asked += 1
            if self.asked > 1:  # the first call is for the deadline in the request
                raise KeyboardInterrupt
            return 0.0

    proxy = host.proxy("calculator")
    with pytest.raises(KeyboardInterrupt):
        proxy.remaining(deadline=Deadline(5.0, CtrlC()))
    assert proxy.double(np.ones(1)).value[0] == 2.0


class Gate:
    """Object whose calls all wait until it is opened."""

    def __init__(self) -> None:
        self.arrived = threading.Semaphore(0)
        self.opened = threading.Event()

    def wait(self) -> None:
        self.arrived.release()
        assert self.opened.wait(30.0)

    def look(self) -> int:
        return 7


def test_calls_at_the_same_time_do_not_wait_for_each_other_and_leave_one_connection(tmp_path: Path) -> None:
    gate = Gate()
    server = HostServer({"gate": gate}, str(tmp_path / "socket"), b"key", WallClock())
    proxy = Proxy(server.address, b"key", "gate", WallClock())
    slow = [threading.Thread(target=proxy.wait) for _ in range(5)]
    for thread in slow:
        thread.start()
    for _ in slow:
        assert gate.arrived.acquire(timeout=30.0)
    assert proxy.look() == 7
    gate.opened.set()
    for thread in slow:
        thread.join(30.0)
    assert proxy.look() == 7
    while len(server._connections) > 1:  # a thread of the server notices later that its client has hung up
        slow[0].join(0.001)
    server.close()


def test_a_host_that_accepts_nobody_is_a_timeout(tmp_path: Path) -> None:
    address = str(tmp_path / "socket")
    server = HostServer(make(), address, b"key", WallClock())
    proxy = Proxy(address, b"key", "calculator", WallClock())
    server.close()
    (tmp_path / "socket").unlink(missing_ok=True)
    with pytest.raises(DeviceUnavailable, match="has ended"):
        proxy.double(np.ones(1))
    with socket.socket(socket.AF_UNIX) as deaf:
        deaf.bind(address)
        deaf.listen(1)
        with pytest.raises(DeviceTimeout, match="connect"):
            proxy.remaining(deadline=Deadline.after(WallClock(), -ANSWER_MARGIN_S))


def test_constants_are_known_and_unknown_names_are_not(host: HostProcess) -> None:
    proxy = host.proxy("calculator")
    assert proxy.name == "calculator"
    with pytest.raises(AttributeError, match="fly"):
        proxy.fly()
    with pytest.raises(DeviceUnavailable, match="abacus"):
        host.proxy("abacus")


def test_a_killed_host_is_unavailable() -> None:
    process = HostProcess(make)
    proxy = process.proxy("calculator")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(DeviceUnavailable, match="calculator"):
        proxy.double(np.ones(1))
    process.close()
    assert not process.is_alive()


def test_an_error_while_starting_reaches_the_parent() -> None:
    with pytest.raises(DeviceUnavailable, match="no such port"):
        HostProcess(make_broken)


def test_a_device_of_a_simulated_world_cannot_be_alone() -> None:
    for driver, clock in (("sim:arm", WallClock()), ("serial:tfmini", PacedClock())):
        with pytest.raises(ConfigError, match="cannot be isolated"):
            isolated_device(Context(name="arm", clock=clock), driver, {})


def test_a_closing_server_ends_the_threads_that_wait_for_its_clients(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    faults: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", faults.append)
    before = set(threading.enumerate())
    server = HostServer(make(), str(tmp_path / "socket"), b"key", WallClock())
    proxies = [Proxy(server.address, b"key", "calculator", WallClock()) for _ in range(5)]
    serving = [thread for thread in threading.enumerate() if thread.name == "host-serve" and thread not in before]
    assert len(serving) == 5
    server.close()
    for thread in serving:
        thread.join(30.0)
        assert not thread.is_alive()
    for proxy in proxies:
        with pytest.raises(DeviceUnavailable):
            proxy.double(np.zeros(1))
    assert not faults


def test_a_server_closes_even_if_nobody_accepts_any_more(tmp_path: Path) -> None:
    server = HostServer(make(), str(tmp_path / "socket"), b"key", WallClock())
    server._is_closed.set()  # as if `close` is called while the thread is between two connections
    with socket.socket(socket.AF_UNIX) as bell:
        bell.connect(server.address)
    server._thread.join(30.0)
    server._is_closed.clear()
    closing = threading.Thread(target=server.close, daemon=True)
    closing.start()
    closing.join(30.0)
    assert not closing.is_alive()
