"""ATI Net F/T and Axia80 over UDP, raw data transfer (ATI 9610-05, pp 75-76).

Each record has a sequence number, which reveals lost, repeated and late records; a nonzero `status` marks it invalid.
"""

from __future__ import annotations

import struct
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from drivers.kinds.force_torque import RangeOptions, capabilities
from drivers.transport.link import Link, drain_until_quiet, now_s
from drivers.transport.options import PortNumber, UdpOptions, read_options, udp_opener
from drivers.transport.stream import StreamDevice
from drivers.transport.timebase import Pauses
from hal.clock import Deadline
from hal.devices import DeviceKind, ForceTorqueCapabilities, Wrench
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes

HEADER, STOP, STREAM = 0x1234, 0, 2
RECORD = struct.Struct(">III6i")
FIRST_SEQUENCE = 1
SEND_S = 0.1
SLOW = 3.0  # an interval of so many periods by the options is no usual one


class NetftOptions(UdpOptions, RangeOptions):
    """Options of `udp:netft`; counts per newton and newton metre as the sensor's web page shows them."""

    port: PortNumber = 49_152
    rate_hz: Annotated[
        float, Field(gt=0, le=7000, description="records per second, as set on the sensor's web page")
    ] = 500.0
    counts_per_n: Annotated[float, Field(gt=0, description="counts per newton, from the sensor's web page")] = (
        1_000_000.0
    )
    counts_per_nm: Annotated[float, Field(gt=0, description="counts per newton metre, from the sensor's web page")] = (
        1_000_000.0
    )
    max_age_s: Annotated[float, Field(gt=0, le=1, description="an older sample is not returned")] = 0.05


def request(command: int, count: int = 0) -> bytes:
    """Return the request: 1234h, command, number of records (0: endless)."""
    return struct.pack(">HHI", HEADER, command, count)


class Netft(StreamDevice[Wrench]):
    """ATI force/torque sensor on the network."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self, context: Context, options: NetftOptions) -> None:
        opener, name = udp_opener(options, context.name)
        super().__init__(context, open_link=opener, link_name=name, max_age_s=options.max_age_s, silence_s=0.3)
        self._options = options
        self._last: int | None = None
        self._last_sample = 0
        self._may_be_new = False
        self._pauses = Pauses(longest_s=SLOW / options.rate_hz)

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(self._options, self._options.rate_hz)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Stop any running stream and start a new one."""
        link.write(request(STOP), now_s() + SEND_S)
        drain_until_quiet(link, quiet_s=0.02, until_s=now_s() + SEND_S)
        link.write(request(STREAM), now_s() + SEND_S)
        self._last = None
        self._pauses.reset()

    def receive(self, chunk: bytes, arrived_s: float) -> None:
        """Publish the record; each datagram holds one, and datagrams of other lengths are ignored."""
        if len(chunk) != RECORD.size:
            return
        sequence, samples, status, *counts = RECORD.unpack(chunk)
        is_new_stream = self._begins_stream(sequence, samples)
        last = None if is_new_stream else self._last
        if last is not None and sequence <= last:
            return  # repeated or late record
        self._last, self._last_sample = sequence, samples
        if self._pauses.may_be_held_up(arrived_s, 1):
            return
        o = self._options
        value = Wrench(
            force_n=np.array(counts[:3], dtype=float) / o.counts_per_n,
            torque_nm=np.array(counts[3:], dtype=float) / o.counts_per_nm,
        )
        self.publish(
            value,
            valid_s=arrived_s,
            quality=Quality.INVALID if status else Quality.VALID,
            cause=Cause.DEVICE if status else Cause.NONE,
            missed=sequence - last - 1 if last is not None else 0,
        )

    def _begins_stream(self, sequence: int, samples: int) -> bool:
        """Return whether the sensor has restarted its counting.

        Both a late record and a restarted sensor show an old sample count; after a restart the second record follows.
        """
        if self._last is None or sequence > self._last:
            self._may_be_new = False
            return False
        if sequence == FIRST_SEQUENCE < self._last:
            self._may_be_new = True
            return samples > self._last_sample
        return self._may_be_new and sequence == FIRST_SEQUENCE + 1

    def release(self) -> None:
        """Stop the stream, because the sensor would otherwise load the network without end."""
        link = self.port.link
        super().release()
        if link is not None:
            self._say_stop()

    def _say_stop(self) -> None:
        opener, _ = udp_opener(self._options, self.name)
        link = opener()
        try:
            link.write(request(STOP), now_s() + SEND_S)
        finally:
            link.close()


@takes(NetftOptions)
def connect(context: Context, options: dict[str, Any]) -> Netft:
    """Entry point `udp:netft`."""
    device = Netft(context, read_options(context, options, NetftOptions))
    device.join()
    return device
