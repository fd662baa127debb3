"""Force/torque sensor of a ROS 2 system: WrenchStamped over rosbridge."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from drivers.kinds.force_torque import RangeOptions, capabilities
from drivers.ros2.messages import WRENCH_STAMPED, wrench_of
from drivers.ros2.rosbridge import MessageTimes, Ros2Options, RosbridgeDevice, Topic
from drivers.transport.link import Link
from drivers.transport.options import read_options
from hal.clock import Deadline
from hal.devices import DeviceKind, ForceTorqueCapabilities, Wrench
from hal.readings import Cause, Quality, Stamped
from hal.registry import Context, takes


class Ros2ForceTorqueOptions(Ros2Options, RangeOptions):
    """Options of `ros2:force_torque`."""

    topic: Topic = Field(
        default="/force_torque_sensor_broadcaster/wrench", description="topic of the geometry_msgs/WrenchStamped"
    )
    sign: Literal[-1, 1] = Field(
        default=1, description="1 if the topic has the wrench of the environment on the tool, -1 if the opposite"
    )
    rate_hz: Annotated[float, Field(gt=0, le=7000)] = Field(default=100.0, description="rate of the topic")


class Ros2ForceTorque(RosbridgeDevice[Wrench]):
    """Force/torque sensor behind rosbridge."""

    kind = DeviceKind.FORCE_TORQUE

    def __init__(self, context: Context, options: Ros2ForceTorqueOptions) -> None:
        super().__init__(context, options, topics={options.topic: WRENCH_STAMPED})
        self._options = options
        self._times = MessageTimes(1.0 / options.rate_hz)

    def capabilities(self) -> ForceTorqueCapabilities:
        """Return the capabilities given by the options."""
        return capabilities(self._options, self._options.rate_hz)

    def read_wrench(self, *, deadline: Deadline) -> Stamped[Wrench]:
        """Return the newest raw wrench."""
        return self.newest(deadline)

    def start(self, link: Link) -> None:
        """Subscribe."""
        self._times.reset()
        super().start(link)

    def take(self, topic: str, message: dict[str, Any], raw: bytes, arrived_s: float) -> None:  # noqa: ARG002  # one topic
        """Publish a wrench; one that is not finite is invalid, because ROS drivers report a lost sensor so."""
        stamp_s, force, torque = wrench_of(message)
        times = self._times.of(stamp_s, raw, arrived_s)
        if times is None:
            return
        valid_s, device_s = times
        is_finite = bool(np.all(np.isfinite(force)) and np.all(np.isfinite(torque)))
        sign = float(self._options.sign)
        self.publish(
            Wrench(force_n=sign * force, torque_nm=sign * torque),
            valid_s=valid_s,
            device_time_s=device_s,
            quality=Quality.VALID if is_finite else Quality.INVALID,
            cause=Cause.NONE if is_finite else Cause.DEVICE,
        )


@takes(Ros2ForceTorqueOptions)
def connect(context: Context, options: dict[str, Any]) -> Ros2ForceTorque:
    """Entry point `ros2:force_torque`."""
    device = Ros2ForceTorque(context, read_options(context, options, Ros2ForceTorqueOptions))
    device.join()
    return device
