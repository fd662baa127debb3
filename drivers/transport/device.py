"""Base of all drivers: mailbox, health, time stamps, and errors that name the device."""

from __future__ import annotations

import math
import threading
from abc import abstractmethod
from typing import Any, ClassVar, Generic, TypeVar

from drivers.transport.link import BYTES_WITHOUT_SENSE, NOT_A_BYTE, LinkLost, RecordingEnded, Refused, now_s
from drivers.transport.mailbox import RING, Mailbox
from drivers.transport.port import Port
from hal.clock import Deadline, PacedClock, WallClock
from hal.devices import DeviceKind, Health
from hal.errors import CellError, ConfigError, DeviceFault, DeviceTimeout, DeviceUnavailable
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context

T = TypeVar("T")
SLICE_S = 0.02  # longest wait of a stream reader, so that close() returns soon
CONNECT_S = 3.0  # a set-up whose first answers are lost needs several attempts
REFUSED_S = 1.0  # a port that cannot be opened for this long counts as absent
CLOCK_READINGS = 3
PATIENCE = 6.0  # factor on time limits beside an emulator, which a busy machine delays as much as us


def wall_until(deadline: Deadline, cap_s: float = 3600.0) -> float:
    """Return the deadline on the links' clock, because links wait in wall time whatever the cell's clock."""
    return now_s() + min(deadline.remaining_s(), cap_s)


class WireDevice(Generic[T]):
    """Base of all drivers: holds the newest sample, the device's health and its errors.

    Args:
        max_age_s: samples older than this are never returned; three periods are usual. In a real cell whose safety
            section allows older readings, the cell's limit applies, because a busy host is not a device fault. With a
            simulated world this limit is kept, because the world waits for a late sample: a controller must not keep
            moving an arm, whose set-points may be delayed on the link, from an old state.
    """

    kind: ClassVar[DeviceKind]
    ring: ClassVar[int] = RING  # samples kept for readers that want every one; fewer of images

    def __init__(self, context: Context, *, max_age_s: float) -> None:
        self.context = context
        cell = context.cell
        is_mixed = cell is not None and cell.file.cell.mode == "mixed"
        self.is_emulated = is_mixed and cell is not None and context.name in cell.file.emulators
        self.patience = PATIENCE if self.is_emulated else 1.0
        self.max_age_s = max_age_s
        if cell is not None and not is_mixed:
            self.max_age_s = max(max_age_s, cell.file.safety.max_reading_age_s)
        if self.is_emulated and self.kind is DeviceKind.ARM:
            # While the world runs ahead of the link the arm moves unseen by the tracking guard: 5 mm at 0.25 m/s.
            self.max_age_s = max_age_s / 2.0
        self.mailbox: Mailbox[T] = Mailbox(ring=self.ring)
        self.errors = 0
        self._sequence = 0
        self._last_stamps: tuple[float, float | None] = (-math.inf, None)  # of the newest sample: host, device
        self._is_closed = False
        self._state = threading.Lock()
        self._last_error = "not connected yet"
        self.identified = ""  # vendor, product and revision, where the protocol tells them

    @property
    def name(self) -> str:
        """Return the device's name in the cell file."""
        return self.context.name

    def publish(
        self,
        value: T,
        *,
        valid_s: float,
        device_time_s: float | None = None,
        quality: Quality = Quality.VALID,
        cause: Cause = Cause.NONE,
        detail: str = "",
        missed: int = 0,
    ) -> None:
        """Publish a new sample to all readers.

        Stamps rise. Where a better estimate of the device's clock would set one back, it is set just after the one before,
        whose error was larger. A sample that the device took no later than the one before is dropped.

        Args:
            valid_s: when the value was valid, on the links' clock.
            missed: samples known to be lost just before this one; the sequence number skips them.
        """
        host_time_s, (last_s, last_device_s) = self._on_cell_clock(valid_s), self._last_stamps
        if host_time_s <= last_s:
            if device_time_s is not None and last_device_s is not None and device_time_s <= last_device_s:
                self.errors += 1
                return
            host_time_s = math.nextafter(last_s, math.inf)
        self._last_stamps = (host_time_s, device_time_s)
        self._sequence += 1 + missed
        self.errors += missed
        self.mailbox.publish(
            Stamped(
                value=value,
                host_time_s=host_time_s,
                sequence=self._sequence,
                device_time_s=device_time_s,
                quality=quality,
                cause=cause,
                detail=detail,
            )
        )

    def _on_cell_clock(self, valid_s: float) -> float:
        clock = self.context.clock
        if isinstance(clock, WallClock):
            return valid_s  # the links' clock
        if self.is_emulated and isinstance(clock, PacedClock):
            return clock.at_s(valid_s)
        readings = []
        for _ in range(CLOCK_READINGS):  # a thread switch between the two clocks would shift the stamp by its length
            before_s, cell_s, after_s = now_s(), clock.now_s(), now_s()
            readings.append((after_s - before_s, cell_s - after_s))
        return valid_s + min(readings)[1]

    def newest(self, deadline: Deadline, *, not_before_s: float | None = None) -> Stamped[T]:
        """Return the newest sample, at most `max_age_s` old; wait for one until the deadline.

        Args:
            not_before_s: on the cell's clock; only a sample valid at or after this time is returned, whatever its age.

        Raises:
            DeviceTimeout: no sample in time. DeviceUnavailable: the link is down. DeviceFault: the device reports a fault.
        """
        self.require_open()
        clock, started_s, until_s = self.context.clock, now_s(), wall_until(deadline)
        errors_since_s = -math.inf if not_before_s is None else started_s
        while True:
            oldest_s = clock.now_s() - self.max_age_s if not_before_s is None else not_before_s
            sample = self.mailbox.wait(oldest_host_s=oldest_s, until_s=until_s, errors_since_s=errors_since_s)
            if sample is None:
                raise self.timeout(now_s() - started_s)
            # A sample delayed on the link may have been young enough when the wait began and be too old now.
            if not_before_s is not None or sample.age_s(clock.now_s()) <= self.max_age_s:
                return sample

    def require_open(self) -> None:
        """Raise an error if the device has been closed."""
        if self._is_closed:
            raise DeviceUnavailable(f"{self.name} is closed", hint="connect it again", device=self.name)

    def timeout(self, waited_s: float) -> DeviceTimeout:
        """Return the error for a silent device, with what is known about the silence."""
        self.errors += 1
        newest, now = self.mailbox.peek(), self.context.clock.now_s()
        age = f"last good reading {newest.age_s(now):.2f} s old" if newest else "no good reading so far"
        return DeviceTimeout(
            f"{self.name} silent for {waited_s:.2f} s; {age}",
            hint="check power and cable; a wrong baud rate or another device on the port looks the same",
            device=self.name,
            link=self.link_name(),
            counts=self.wire_counts(),
        )

    def fail(self, error: Exception) -> None:
        """Make readers raise this error until the next sample arrives."""
        self.errors += 1
        as_cell_error = self.translate(error)
        self._last_error = str(as_cell_error)
        self.mailbox.fail(as_cell_error)

    def translate(self, error: Exception) -> CellError:
        """Return the `hal` error that corresponds to a link error, with the device's name."""
        if isinstance(error, CellError):
            return error
        where = {"device": self.name, "link": self.link_name()}
        if isinstance(error, Refused):
            return DeviceFault(f"{self.name}: {error}", hint=error.hint, code=error.code, **where)
        if isinstance(error, LinkLost):
            hint = "plug the device in; it is connected again automatically"
            if isinstance(error, RecordingEnded):
                hint = "nothing more was recorded; connect the device again to replay the recording"
            return DeviceUnavailable(f"{self.name} is disconnected: {error}", hint=hint, **where)
        return DeviceTimeout(f"{self.name}: {error}", hint=self._silence_hint(), counts=self.wire_counts(), **where)

    def heard_bytes(self) -> int | None:
        """Return the number of bytes received so far, or None where the link does not count them."""
        return None

    def _silence_hint(self) -> str:
        heard = self.heard_bytes()
        if heard is None or self.mailbox.published:
            return "check power and cable; is it the right device and baud rate?"
        return BYTES_WITHOUT_SENSE if heard else NOT_A_BYTE

    def health(self) -> Health:
        """Return the state of the link and of the newest sample, without waiting."""
        newest, error = self.mailbox.peek(), self.mailbox.error()
        quality, cause = self._condition(newest, error)
        said = newest.detail if newest else ""
        told = (self.link_name(), self.identified, self.wire_counts(), error.what if error else said)
        return Health(
            connected=self.is_up() and not self._is_closed,
            quality=quality,
            cause=cause,
            detail="; ".join(text for text in told if text),
            samples=self.mailbox.published,
            errors=self.errors,
            reconnects=self.reconnects(),
            last_sample_s=newest.host_time_s if newest else None,
        )

    def _condition(self, newest: Stamped[T] | None, error: CellError | None) -> tuple[Quality, Cause]:
        if self._is_closed or isinstance(error, DeviceUnavailable) or not self.is_up():
            return Quality.INVALID, Cause.COMM
        if isinstance(error, DeviceFault):
            return Quality.INVALID, Cause.DEVICE
        if error or newest is None or newest.age_s(self.context.clock.now_s()) > self.max_age_s:
            return Quality.INVALID, Cause.TIMEOUT
        return newest.quality, newest.cause

    def await_first(self, timeout_s: float = CONNECT_S) -> None:
        """Wait for the first sample; if none comes, close the device and raise the reason.

        Raises:
            DeviceUnavailable: the last error is its cause.
        """
        started_s = now_s()
        until_s = started_s + self.patience * timeout_s
        while now_s() < until_s and self.mailbox.peek() is None:
            try:
                self.mailbox.wait(oldest_host_s=-math.inf, until_s=until_s)
            except (ConfigError, DeviceUnavailable) as refusal:
                if isinstance(refusal, ConfigError) or now_s() > started_s + REFUSED_S:
                    break  # no further attempt would succeed
                threading.Event().wait(SLICE_S)  # another attempt to open the port follows
            except CellError:
                threading.Event().wait(SLICE_S)
        if self.mailbox.peek() is not None:
            return
        why, counts, error, hint = self._last_error, self.wire_counts(), self.mailbox.error(), self._silence_hint()
        self.close()
        why = (error.what if error else why).removeprefix(f"{self.name}: ").removeprefix("no valid data ")
        raise DeviceUnavailable(
            f"{self.name} gives no valid data: {why}" + ("" if " samples, " in why else f" ({counts})"),
            hint=error.hint if error else hint,
            device=self.name,
            link=self.link_name(),
        )

    def close(self) -> None:
        """Release port and thread; a second call does nothing."""
        with self._state:
            if self._is_closed:
                return
            self._is_closed = True
        self.mailbox.fail(DeviceUnavailable(f"{self.name} is closed", hint="connect it again", device=self.name))
        self.release()

    @abstractmethod
    def release(self) -> None:
        """Release thread and port; called once."""

    @abstractmethod
    def is_up(self) -> bool:
        """Return whether the link is open and set up."""

    @abstractmethod
    def reconnects(self) -> int:
        """Return how many times the link was set up again."""

    @abstractmethod
    def link_name(self) -> str:
        """Return the link's name: port and baud rate, or network address."""

    def wire_counts(self) -> str:
        """Return the counters that distinguish a wrong baud rate from a dead device, as text."""
        return f"{self.mailbox.published} samples, {self.errors} errors"


class PortDevice(WireDevice[T]):
    """Device with its own port and therefore its own owner thread; the subclass creates `port`."""

    port: Port[Any]

    def lost(self, error: Exception) -> None:
        """Report the loss to all readers (owner thread)."""
        self.fail(error)

    def release(self) -> None:
        """End the owner thread, which closes the link."""
        self.port.close()

    def is_up(self) -> bool:
        """Return whether the link is open and set up."""
        return self.port.link is not None

    def reconnects(self) -> int:
        """Return how many times the link was set up again."""
        return self.port.reconnects
