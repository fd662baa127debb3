"""Connection to rosbridge, by which every ROS 2 topic, service and action can be used over a WebSocket (protocol 2.0).

Nothing of ROS need be installed here, and any distribution of ROS 2 works, as do its middlewares.
"""

from __future__ import annotations

import itertools
import json
import threading
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Annotated, Any, TypeVar

from pydantic import Field

from drivers.ros2.messages import BadMessage
from drivers.transport.device import wall_until
from drivers.transport.host_claim import HostClaim, TakenBy
from drivers.transport.link import Link, LinkLost, Refused, WireError, now_s
from drivers.transport.options import CONNECT_TIMEOUT_S, PortNumber, TcpOptions, opener_with_files
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import FrameTimes, HostTime
from drivers.transport.websocket_link import open_websocket
from hal.clock import Deadline
from hal.errors import DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.registry import Context
from hal.wires import ResourceClaim

T = TypeVar("T")
SEND_S = 0.2
SERVICE_HINT = "is the node that offers it running? `ros2 service list` and `ros2 action list` tell"
Topic = Annotated[str, Field(min_length=1, pattern=r"^/?[A-Za-z_~{][A-Za-z0-9_/~{}]*$")]


class Ros2Options(TcpOptions):
    """Keys of every device behind rosbridge; each has a connection of its own."""

    host: str = Field(default="127.0.0.1", description="the machine that runs rosbridge_server")
    port: PortNumber = Field(default=9090, description="the port of rosbridge_server's WebSocket")
    max_age_s: Annotated[float, Field(gt=0, le=2)] = Field(
        default=0.1, description="older messages are not given out; three periods of the topic are usual"
    )

    def commanded(self) -> tuple[str, ...]:
        """Return the topics and actions that only one device may command."""
        return ()

    def claim(self) -> ResourceClaim:
        """Claim the topics and actions that the device commands."""
        return ResourceClaim(wire=f"tcp {self.host}:{self.port}", bus="rosbridge", stations=self.commanded())


@dataclass(slots=True)
class _Waiting:
    """A request whose answer has not arrived yet."""

    done: threading.Event = field(default_factory=threading.Event)
    answer: dict[str, Any] | None = None


class MessageTimes:
    """Gives the host time of stamped messages, and of unstamped ones by the rules for streams without a clock.

    Args:
        period_s: nominal time between two messages.
    """

    def __init__(self, period_s: float) -> None:
        self._host = HostTime()
        self._frames = FrameTimes(period_s=period_s, frame_bytes=0)

    def reset(self) -> None:
        """Prepare for a reopened connection."""
        self._host.reset()
        self._frames.reset()

    def of(self, stamp_s: float, raw: bytes, arrived_s: float) -> tuple[float, float | None] | None:
        """Return the message's time on the links' clock and its stamp; None when its age cannot be known."""
        if stamp_s > 0.0:
            return self._host.host_s(device_s=stamp_s, arrived_s=arrived_s), stamp_s
        stamped = self._frames.stamped([raw], arrived_s=arrived_s, byte_s=0.0)
        return (stamped[0][1], None) if stamped else None


class RosbridgeDevice(StreamDevice[T]):
    """Device behind rosbridge; the subclass says what it subscribes to, and takes the messages.

    Args:
        topics: subscribed topics with their message types.
        outputs: topics that it publishes, with their message types.
    """

    def __init__(
        self, context: Context, options: Ros2Options, *, topics: dict[str, str], outputs: dict[str, str] | None = None
    ) -> None:
        opener = opener_with_files(options, context.name, lambda: self._open(options))
        name = f"rosbridge {options.host}:{options.port}"
        super().__init__(context, open_link=opener, link_name=name, max_age_s=options.max_age_s)
        self._topics, self._outputs = topics, outputs or {}
        self._commanded = options.commanded()
        self._place = f"{options.host}:{options.port}"
        self._is_replay = options.replay is not None
        cell = f" of cell {context.cell.file.cell.name}" if context.cell is not None else ""
        self._claim = HostClaim(f"{context.name}{cell}")
        self._numbers = itertools.count(1)
        self._waiting: dict[str, _Waiting] = {}
        self._refusal = ""
        self._odd = ""

    @abstractmethod
    def take(self, topic: str, message: dict[str, Any], raw: bytes, arrived_s: float) -> None:
        """Publish a message of a subscribed topic.

        Raises:
            BadMessage: it is not as its type says.
        """

    def _open(self, options: Ros2Options) -> Link:
        timeout_s = self.patience * CONNECT_TIMEOUT_S
        return open_websocket(options.host, options.port, timeout_s=timeout_s, device=self.name)

    def start(self, link: Link) -> None:
        """Take what it commands, subscribe and advertise; rosbridge has forgotten both if the connection was lost.

        Raises:
            DeviceUnavailable: another process of this machine commands the same.
        """
        if not self._is_replay:
            for each in self._commanded:
                self._take_claim(each)
        self._refusal = self._odd = ""
        for topic, type_ in self._outputs.items():
            self._write(link, {"op": "advertise", "topic": topic, "type": type_})
        for topic, type_ in self._topics.items():  # only the newest message is of use
            order = {"op": "subscribe", "topic": topic, "type": type_, "queue_length": 1, "throttle_rate": 0}
            self._write(link, order)

    def _take_claim(self, what: str) -> None:
        try:
            self._claim.take(f"{self._place}{what}")
        except TakenBy as taken:
            raise DeviceUnavailable(
                f"{self.name}: {what} at rosbridge {self._place} is taken by {taken.owner}",
                hint="end that program, or give one of the two another arm or gripper",
                device=self.name,
                owner=taken.owner,
            ) from None

    def _write(self, link: Link, message: dict[str, Any], until_s: float | None = None) -> None:
        text = json.dumps(message, allow_nan=False, separators=(",", ":"))
        link.write(text.encode(), now_s() + SEND_S if until_s is None else until_s)

    def send(self, topic: str, message: dict[str, Any], deadline: Deadline) -> None:
        """Publish a message.

        Raises:
            DeviceUnavailable, DeviceTimeout: the connection is down, or does not accept it in time.
            DeviceFault: rosbridge has refused an earlier message.
        """
        self.require_accepted()
        self._order({"op": "publish", "topic": topic, "msg": message}, deadline)

    def require_accepted(self) -> None:
        """Raise `DeviceFault` once if rosbridge has refused a message since the last call."""
        refusal, self._refusal = self._refusal, ""
        if refusal:
            hint = "compare topics and types with `ros2 topic info`"
            raise DeviceFault(f"{self.name}: rosbridge refuses: {refusal}", hint=hint, device=self.name)

    def _order(self, message: dict[str, Any], deadline: Deadline) -> None:
        link = self.port.link
        try:
            if link is None:
                raise LinkLost("the connection to rosbridge is down")
            self._write(link, message, wall_until(deadline))
        except WireError as error:
            self.errors += 1
            raise self.translate(error) from error

    def begin(self, message: dict[str, Any], deadline: Deadline) -> str:
        """Send a request or a goal; return its id, under which `answer` finds its answer."""
        id_ = f"{self.name}-{next(self._numbers)}"
        self._waiting[id_] = _Waiting()
        try:
            self._order({**message, "id": id_}, deadline)
        except Exception:
            self._waiting.pop(id_, None)
            raise
        return id_

    def call_service(self, service: str, args: dict[str, Any], deadline: Deadline) -> dict[str, Any]:
        """Call a ROS service and return its answer.

        Raises:
            DeviceTimeout: no answer before the deadline. DeviceFault: the call failed.
        """
        id_ = self.begin({"op": "call_service", "service": service, "args": args}, deadline)
        waiting = self._waiting[id_]
        waiting.done.wait(max(0.0, wall_until(deadline) - now_s()))
        self._waiting.pop(id_, None)
        answer = waiting.answer
        if answer is None:
            raise DeviceTimeout(
                f"{self.name}: the service {service} does not answer", hint=SERVICE_HINT, device=self.name
            )
        values = answer.get("values")
        if answer.get("result") is not True or not isinstance(values, dict):
            what = f"{self.name}: the call of {service} failed: {values}"
            raise DeviceFault(what, hint=SERVICE_HINT, device=self.name)
        return values

    def answer(self, id_: str) -> dict[str, Any] | None:
        """Return the answer to a request or goal, or None before it arrives; never waits."""
        waiting = self._waiting.get(id_)
        return None if waiting is None else waiting.answer

    def forget(self, id_: str) -> None:
        """Forget a request or goal, whose answer is of no interest any more."""
        self._waiting.pop(id_, None)

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Take each message; what is no JSON object, or not of its type, is counted and skipped."""
        for line in chunk.splitlines():
            try:
                message = json.loads(line)
                if not isinstance(message, dict):
                    raise BadMessage("a message of rosbridge is no object")
                self._dispatch(message, line, arrived_s)
            except (ValueError, RecursionError) as error:  # also BadMessage and damaged text
                self.errors += 1
                self._odd = f"; {error}"

    def _dispatch(self, message: dict[str, Any], raw: bytes, arrived_s: float) -> None:
        match message.get("op"):
            case "publish":
                topic, body = message.get("topic"), message.get("msg")
                if isinstance(topic, str) and isinstance(body, dict) and topic in self._topics:
                    self.take(topic, body, raw, arrived_s)
            case "service_response" | "action_result":
                waiting = self._waiting.get(str(message.get("id")))
                if waiting is not None:
                    waiting.answer = message
                    waiting.done.set()
            case "status" if message.get("level") == "error":
                self._refusal = str(message.get("msg"))
                self.fail(
                    Refused(f"rosbridge says: {self._refusal}", code=0, hint="look at the log of rosbridge_server")
                )

    def wire_counts(self) -> str:
        """Return the stream's counters, and what was odd about messages."""
        refusal = f"; rosbridge refuses: {self._refusal}" if self._refusal else ""
        return super().wire_counts() + self._odd + refusal

    def lost(self, error: Exception) -> None:
        """End all waiting for answers, and report the loss."""
        for waiting in list(self._waiting.values()):
            waiting.done.set()
        super().lost(error)

    def release(self) -> None:
        """End the connection, which ends subscriptions, and release what it commands."""
        super().release()
        self._claim.release()
