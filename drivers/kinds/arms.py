"""Code shared by arm drivers: kinematics from the options, and the checks on every set-point before it is sent."""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator

from drivers.kinds.digital_points import require_same_number
from hal.arrays import Array
from hal.devices import ArmCapabilities, DhLink
from hal.errors import InvalidRequest, MotionRefused
from hal.strict import Strict

Positive = Annotated[float, Field(gt=0)]
RATE_MARGIN = 1.1  # travel granted per second, as a multiple of the speed limit: set-points do not arrive evenly
BURST_S, BURST_PERIODS = (
    0.04,
    1.5,
)  # travel at the speed limit that may be saved up; with the margin 1.5 times the limit


class LinkOptions(Strict):
    """One row of a standard Denavit-Hartenberg table."""

    d_m: Annotated[float, Field(description="offset along the previous axis")]
    a_m: Annotated[float, Field(description="length of the common normal")]
    alpha_rad: Annotated[float, Field(description="twist about the common normal")]
    offset_rad: Annotated[float, Field(description="joint angle of the table at 0 rad of the drive")] = 0.0


class KinematicsOptions(Strict):
    """`kinematics` of an arm's options; the values are in the arm's data sheet."""

    model: Annotated[str, Field(description="name of the arm, which errors and reports show")]
    links: Annotated[
        tuple[LinkOptions, ...], Field(description="rows of the standard Denavit-Hartenberg table, from the base")
    ]
    lower_rad: Annotated[tuple[float, ...], Field(description="lower limit of each joint")]
    upper_rad: Annotated[tuple[float, ...], Field(description="upper limit of each joint")]
    velocity_rad_per_s: Annotated[tuple[Positive, ...], Field(description="largest speed of each joint")]
    acceleration_rad_per_s2: Annotated[tuple[Positive, ...], Field(description="largest acceleration of each joint")]
    tip_speed_m_per_s: Annotated[Positive, Field(description="largest speed of the flange")]
    link_radius_m: Annotated[tuple[Positive, ...], Field(description="radius of each link for collision checks")]

    @classmethod
    def example(cls) -> dict[str, Any]:
        """Return the table of a UR10e, which the option reference shows."""
        return ur10e().model_dump(mode="json")

    @model_validator(mode="after")
    def _one_entry_a_joint(self) -> Self:
        lists = (self.links, self.lower_rad, self.upper_rad, self.velocity_rad_per_s, self.acceleration_rad_per_s2)
        require_same_number("links, limits and link_radius_m", *lists, self.link_radius_m)
        if any(low >= high for low, high in zip(self.lower_rad, self.upper_rad, strict=True)):
            raise ValueError("each of lower_rad must be below its upper_rad")
        return self


def require_stations(what: str, stations: Sequence[int], k: KinematicsOptions) -> None:
    """Check that there is one station per joint and that all differ.

    Raises:
        ValueError: the check fails; `what` is the key that lists the stations.
    """
    if len(stations) != len(k.links) or len(set(stations)) != len(stations):
        raise ValueError(
            f"{what} must be {len(k.links)} different numbers, because kinematics has {len(k.links)} links"
        )


def kinematics_of(c: ArmCapabilities) -> dict[str, Any]:
    """Return the options that describe an arm of another backend; emulators pass them to the driver."""
    return {
        "model": c.model,
        "links": [{"d_m": x.d_m, "a_m": x.a_m, "alpha_rad": x.alpha_rad, "offset_rad": x.offset_rad} for x in c.links],
        "lower_rad": list(c.lower_rad),
        "upper_rad": list(c.upper_rad),
        "velocity_rad_per_s": list(c.velocity_rad_per_s),
        "acceleration_rad_per_s2": list(c.acceleration_rad_per_s2),
        "tip_speed_m_per_s": c.tip_speed_m_per_s,
        "link_radius_m": list(c.link_radius_m),
    }


def ur10e() -> KinematicsOptions:
    """Return the published table of the UR10e, with the default limits and with radii rounded up."""
    quarter = math.pi / 2.0
    rows = (
        (0.1807, 0.0, quarter),
        (0.0, -0.6127, 0.0),
        (0.0, -0.57155, 0.0),
        (0.17415, 0.0, quarter),
        (0.11985, 0.0, -quarter),
        (0.11655, 0.0, 0.0),
    )
    return KinematicsOptions(
        model="ur10e",
        links=tuple(LinkOptions(d_m=d, a_m=a, alpha_rad=alpha) for d, a, alpha in rows),
        lower_rad=(-math.tau,) * 6,
        upper_rad=(math.tau,) * 6,
        velocity_rad_per_s=(2.09, 2.09, 3.14, 3.14, 3.14, 3.14),
        acceleration_rad_per_s2=(5.0,) * 6,
        tip_speed_m_per_s=1.0,
        link_radius_m=(0.10, 0.08, 0.07, 0.06, 0.06, 0.05),
    )


def capabilities(
    k: KinematicsOptions, *, command_rate_hz: float, watchdog_s: float | None, resolution_rad: float = 0.0
) -> ArmCapabilities:
    """Return the arm's capabilities from its kinematics options."""
    return ArmCapabilities(
        model=k.model,
        links=tuple(DhLink(d_m=x.d_m, a_m=x.a_m, alpha_rad=x.alpha_rad, offset_rad=x.offset_rad) for x in k.links),
        lower_rad=k.lower_rad,
        upper_rad=k.upper_rad,
        velocity_rad_per_s=k.velocity_rad_per_s,
        acceleration_rad_per_s2=k.acceleration_rad_per_s2,
        tip_speed_m_per_s=k.tip_speed_m_per_s,
        command_rate_hz=command_rate_hz,
        link_radius_m=k.link_radius_m,
        watchdog_s=watchdog_s,
        resolution_rad=resolution_rad,
    )


class SetPointFilter:
    """Final check of set-points: shape, finite values, limits, and no jump from the previous one.

    Each joint has a travel budget, in seconds at its speed limit. It grows with the time between set-points, by
    `RATE_MARGIN` per second, up to `BURST_S` (more for an arm with slow set-points), and each set-point spends what it
    travels. So in any time T a joint is sent at most `BURST_S + RATE_MARGIN T` seconds of travel at its speed limit, in
    0.1 s 1.5 times the limit, however the set-points arrive. A pause saves up no more than `BURST_S`.

    Any thread may close the filter, for example after a stop or a lost link, while the control thread is processing a
    set-point or enabling the drives.
    """

    def __init__(self, name: str, k: KinematicsOptions, *, command_rate_hz: float) -> None:
        self._name = name
        self._lower, self._upper = np.array(k.lower_rad), np.array(k.upper_rad)
        self._velocity = np.array(k.velocity_rad_per_s)
        self._period_s = 1.0 / command_rate_hz
        self._burst_s = max(BURST_S, BURST_PERIODS * self._period_s)
        self._budget_s: Array = np.zeros_like(self._lower)
        self._last: Array | None = None
        self._last_s: float | None = None
        self._closings = 0
        self._passing = threading.Lock()

    @property
    def closings(self) -> int:
        """Return how often the filter was closed; code that enables the drives reads this before it begins."""
        return self._closings

    def check_not_closed_since(self, closings: int) -> None:
        """Raise `MotionRefused` if the filter was closed after `closings` was read."""
        if self._closings != closings:
            raise MotionRefused(
                f"{self._name}: stopped, or its link lost, while the drives were being enabled",
                hint="check the arm, then send the command again",
                device=self._name,
            )

    def begin(self, measured_rad: Array, *, closings: int) -> None:
        """Open the filter with this position as the previous set-point.

        Args:
            closings: value when the enabling began: a stop since then takes precedence, or the arm would move after it.

        Raises:
            MotionRefused: the filter was closed meanwhile.
        """
        with self._passing:
            self.check_not_closed_since(closings)
            self._last, self._last_s = measured_rad, None

    def close(self) -> None:
        """Reject all set-points, including those of an enabling in progress."""
        with self._passing:
            self._last = None
            self._closings += 1

    @property
    def is_open(self) -> bool:
        """Return whether set-points may pass."""
        return self._last is not None

    def passed(self, wanted_rad: Array, now_s: float) -> Array:
        """Return the set-point clipped to what may be sent.

        Raises:
            InvalidRequest: wrong shape or not finite. MotionRefused: not enabled.
        """
        wanted = np.asarray(wanted_rad, dtype=float)
        if wanted.shape != self._lower.shape or not np.all(np.isfinite(wanted)):
            raise InvalidRequest(
                f"{self._name}: a set-point must be {len(self._lower)} finite joint angles",
                hint="check the planner that sent it",
                device=self._name,
            )
        with self._passing:
            if self._last is None:
                raise MotionRefused(f"{self._name}: the drives are off", hint="call enable first", device=self._name)
            budget_s = self._granted_s(now_s)
            step = self._velocity * budget_s
            allowed = np.clip(wanted, self._lower, self._upper)
            sent: Array = np.clip(allowed, self._last - step, self._last + step)  # last: nor may a limit make it jump
            self._budget_s = np.maximum(budget_s - np.abs(sent - self._last) / self._velocity, 0.0)
            self._last, self._last_s = sent, now_s if self._last_s is None else max(now_s, self._last_s)
            return sent

    def _granted_s(self, now_s: float) -> Array:
        """Return the travel that each joint may be sent now; the first set-point after enabling may travel one period."""
        if self._last_s is None:
            return np.full_like(self._lower, RATE_MARGIN * self._period_s)
        elapsed_s = max(0.0, now_s - self._last_s)
        granted: Array = np.minimum(self._budget_s + RATE_MARGIN * elapsed_s, self._burst_s)
        return granted
