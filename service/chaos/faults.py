"""The faults of a run of chaos: each breaks one thing, says what must follow, and is undone afterwards."""

from __future__ import annotations

import os
import random
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from hal.errors import CellError
from hal.simulated import Fault as DeviceFault
from service.chaos.acks import Acks
from service.chaos.family import Process
from service.chaos.plant import Plant
from service.client import ApiError

SILENT_CONNECTIONS = 300
QUEUED_TASKS = 40
LAPSED_S = 3.0  # a lease of 2 s has lapsed, and the step that runs has noticed
GARBAGE = 60
ENDS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
# No beginning of one is an object, which some verbs take as a request.
ODD_BODIES = (b'{"objects": NaN}', b"[" * 5000, b'{"a": 1e400}', b'{"a": "\\ud800"}', b"\xff\xfe\x00", b"[]" * 9)
Undo = Callable[[], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class Scene:
    """What a fault works on.

    Attributes:
        verb, body: the task that runs, which is asked for again to fill the queue.
        devices: names of devices that take injected faults.
    """

    plant: Plant
    acks: Acks
    random: random.Random
    verb: str
    body: dict[str, object]
    devices: tuple[str, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Broken:
    """A fault that has begun: how it is undone, and which thing exactly was broken."""

    undo: Undo = lambda: None
    what: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ChaosFault:
    """One kind of fault.

    Attributes:
        latches: whether the stop must be latched afterwards, without anybody's doing.
        ends: whether the task must end without success while the fault lasts.
        acts_after_s: until then the fault reaches no task, so that one which is nearly done may still succeed.
        restarts: whether the service ends by it, so that it is started again.
        lasts_s: how long it lasts before it is undone, unless everything that must follow has followed before.
    """

    name: str
    begin: Callable[[Scene], Broken]
    latches: bool = False
    ends: bool = False
    acts_after_s: float = 0.0
    restarts: bool = False
    lasts_s: float = 3.0


def _kill(role: str) -> Callable[[Scene], Broken]:
    return lambda scene: _send(scene, role, signal.SIGKILL)


def _hang(role: str) -> Callable[[Scene], Broken]:
    return lambda scene: _send(scene, role, signal.SIGSTOP)


def _send(scene: Scene, role: str, number: signal.Signals) -> Broken:
    process = scene.plant.roles().get(role)
    if process is None:
        return Broken(what=f"there was no {role} process")
    os.kill(process.pid, number)
    return Broken(undo=lambda: _go_on(process), what=f"pid {process.pid}")


def _go_on(process: Process) -> None:
    if process.is_alive():
        with suppress(ProcessLookupError):
            os.kill(process.pid, signal.SIGCONT)


def _silence_device(scene: Scene) -> Broken:
    if not scene.devices:
        return Broken(what="no device takes faults")
    name, fault = scene.random.choice(scene.devices), scene.random.choice(list(DeviceFault))
    path = f"/v1/devices/{name}/fault"

    def undo() -> None:
        with suppress(CellError):
            scene.plant.client().post(path, {"fault": None}, headers=scene.acks.headers())

    try:
        scene.plant.client().post(path, {"fault": fault.value, "magnitude": 0.0}, headers=scene.acks.headers())
    except CellError as error:
        return Broken(undo=undo, what=f"{name} {fault.value}: refused: {error.what}")
    return Broken(undo=undo, what=f"{name} {fault.value}")


def _silence_client(scene: Scene) -> Broken:
    scene.acks.fall_silent()
    return Broken(what=f"lease of {scene.acks.holder or 'nobody'}")


def _corrupt_requests(scene: Scene) -> Broken:
    """Send broken requests to both ports; every answer must be a refusal, or none."""
    bad: list[str] = []
    for number in range(GARBAGE):
        port = scene.plant.port if number % 3 else scene.plant.stop_port
        answer = _raw(port, _garbage(scene.random))
        if answer[:12].startswith((b"HTTP/1.1 2", b"HTTP/1.1 5")):
            bad.append(answer[:40].decode("latin-1"))
    return Broken(what=f"{GARBAGE} broken requests" + (f"; answered: {bad[0]}" if bad else ""))


def _garbage(draw: random.Random) -> bytes:
    if draw.random() < 0.3:
        return draw.randbytes(draw.randrange(1, 2000)) + b"\r\n\r\n"
    body = draw.choice(ODD_BODIES)
    cut = draw.randrange(1, len(body) + 1)
    path = draw.choice([b"/v1/missions", b"/v1/lease", b"/v1/fuse", b"/v1/manipulate", b"/v1/nothing"])
    head = b"POST " + path + b" HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\nConnection: close\r\n"
    return head + b"Content-Length: %d\r\n\r\n" % cut + body[:cut]


def _raw(port: int, data: bytes) -> bytes:
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=3.0) as connection:
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        return connection.recv(200)
    return b""


def _silent_connections(scene: Scene) -> Broken:
    held: list[socket.socket] = []
    for number in range(SILENT_CONNECTIONS):
        port = scene.plant.port if number % 2 else scene.plant.stop_port
        with suppress(OSError):
            connection = socket.create_connection(("127.0.0.1", port), timeout=1.0)
            connection.sendall(b"POST /v1/st")
            held.append(connection)

    def undo() -> None:
        for connection in held:
            connection.close()

    return Broken(undo=undo, what=f"{len(held)} silent connections")


def _fill_disk(scene: Scene) -> Broken:
    """Let every write of the service fail, as on a full disk, by its limit of file sizes."""
    pid = scene.plant.pid
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, before[1]))

    def undo() -> None:
        with suppress(ProcessLookupError):
            resource.prlimit(pid, resource.RLIMIT_FSIZE, before)

    return Broken(undo=undo, what="no byte can be written")


def _fill_queue(scene: Scene) -> Broken:
    asked: list[str] = []
    refusals: set[str] = set()
    for _ in range(QUEUED_TASKS):
        try:
            asked.append(scene.acks.begin_task(scene.verb, scene.body))
        except ApiError as error:
            refusals.add(str(error.problem.get("type", "no type")).rpartition(":")[2])
            if len(refusals) > 3:
                break
        except CellError as error:
            refusals.add(error.type_name)

    def undo() -> None:
        for task_id in asked:
            with suppress(CellError):
                scene.plant.client().post(f"/v1/tasks/{task_id}/cancel")

    return Broken(undo=undo, what=f"{len(asked)} taken, others refused: {', '.join(sorted(refusals)) or 'none'}")


def _stop(scene: Scene) -> Broken:
    begun_s = time.monotonic()
    scene.acks.stop(at_main_port=scene.random.random() < 0.5)
    return Broken(what=f"answered after {1e3 * (time.monotonic() - begun_s):.0f} ms")


def ends() -> list[signal.Signals]:
    """Return the signals that end a service: not those that it inherits as ignored, such as SIGHUP under `nohup`."""
    return [number for number in ENDS if signal.getsignal(number) is not signal.SIG_IGN]


def _end(scene: Scene) -> Broken:
    taken_s = scene.plant.end(scene.random.choice(ends()))
    return Broken(what=f"gone after {taken_s:.1f} s")


FAULTS = (
    ChaosFault(name="kill service", begin=_kill("service"), restarts=True),
    ChaosFault(name="kill cell", begin=_kill("cell"), latches=True, ends=True, lasts_s=10.0),
    ChaosFault(name="kill world", begin=_kill("world"), latches=True, ends=True, lasts_s=10.0),
    ChaosFault(name="kill stop", begin=_kill("stop"), latches=True, ends=True, lasts_s=10.0),
    ChaosFault(name="hang service", begin=_hang("service"), lasts_s=3.0),
    ChaosFault(name="hang cell", begin=_hang("cell"), latches=True, ends=True, lasts_s=15.0),
    ChaosFault(name="hang world", begin=_hang("world"), latches=True, ends=True, lasts_s=15.0),
    ChaosFault(name="hang stop", begin=_hang("stop"), latches=True, ends=True, lasts_s=10.0),
    ChaosFault(name="silence device", begin=_silence_device, lasts_s=4.0),
    ChaosFault(name="silence client", begin=_silence_client, ends=True, acts_after_s=LAPSED_S, lasts_s=10.0),
    ChaosFault(name="silent connections", begin=_silent_connections),
    ChaosFault(name="corrupt requests", begin=_corrupt_requests),
    ChaosFault(name="fill disk", begin=_fill_disk, ends=True, lasts_s=10.0),
    ChaosFault(name="fill queue", begin=_fill_queue),
    ChaosFault(name="stop", begin=_stop, latches=True, ends=True, lasts_s=5.0),
    ChaosFault(name="end service", begin=_end, restarts=True),
)
