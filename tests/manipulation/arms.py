"""Three arms for tests, and slow reference implementations in plain numpy."""

from __future__ import annotations

import numpy as np

from hal.devices import ArmCapabilities, DhLink

PI = np.pi


def _arm(
    model: str, rows: list[tuple[float, float, float, float]], limit: float, radii: tuple[float, ...]
) -> ArmCapabilities:
    count = len(rows)
    return ArmCapabilities(
        model=model,
        links=tuple(DhLink(d_m=d, a_m=a, alpha_rad=alpha, offset_rad=offset) for d, a, alpha, offset in rows),
        lower_rad=(-limit,) * count,
        upper_rad=(limit,) * count,
        velocity_rad_per_s=(1.6, 1.6, 1.6, 3.2, 3.2, 3.2, 3.2)[:count],
        acceleration_rad_per_s2=(8.0, 8.0, 8.0, 16.0, 16.0, 16.0, 16.0)[:count],
        tip_speed_m_per_s=1.0,
        command_rate_hz=500.0,
        link_radius_m=radii,
    )


T3 = _arm(
    "t3-test",
    [
        (0.42, 0.0, -PI / 2, 0.0),
        (0.0, 0.45, 0.0, -PI / 2),
        (0.0, 0.04, -PI / 2, 0.1),
        (0.45, 0.0, PI / 2, 0.0),
        (0.0, 0.0, -PI / 2, 0.0),
        (0.10, 0.0, 0.0, 0.0),
    ],
    2.9,
    (0.09, 0.07, 0.07, 0.06, 0.05, 0.05),
)
UR = _arm(
    "ur-test",
    [
        (0.1807, 0.0, PI / 2, 0.0),
        (0.0, -0.6127, 0.0, 0.0),
        (0.0, -0.57155, 0.0, 0.0),
        (0.17415, 0.0, PI / 2, 0.0),
        (0.11985, 0.0, -PI / 2, 0.0),
        (0.11655, 0.0, 0.0, 0.0),
    ],
    2 * PI,
    (0.09, 0.07, 0.06, 0.05, 0.05, 0.05),
)
SEVEN = _arm(
    "seven-test",
    [
        (0.34, 0.0, -PI / 2, 0.0),
        (0.0, 0.0, PI / 2, 0.0),
        (0.40, 0.05, PI / 2, 0.0),
        (0.0, -0.05, -PI / 2, 0.0),
        (0.40, 0.0, PI / 2, 0.0),
        (0.0, 0.09, PI / 2, 0.0),
        (0.11, 0.0, 0.0, 0.0),
    ],
    2.9,
    (0.09, 0.07, 0.07, 0.06, 0.06, 0.05, 0.05),
)


def forward(capabilities: ArmCapabilities, q: np.ndarray) -> np.ndarray:
    """Return (4, 4) base_from_flange by elementary rotations, the reference for the compiled chain."""
    pose = np.eye(4)
    for link, angle in zip(capabilities.links, q, strict=True):
        pose = pose @ _rotate(2, angle + link.offset_rad) @ _shift(0, 0, link.d_m) @ _shift(link.a_m, 0, 0)
        pose = pose @ _rotate(0, link.alpha_rad)
    return pose


def _shift(x: float, y: float, z: float) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = x, y, z
    return out


def _rotate(axis: int, angle: float) -> np.ndarray:
    out = np.eye(4)
    i, j = [k for k in range(3) if k != axis]
    c, s = np.cos(angle), np.sin(angle)
    sign = -1.0 if axis != 1 else 1.0
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = sign * s, -sign * s
    return out
