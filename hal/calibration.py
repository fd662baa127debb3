"""Calibration records: where a sensor sits, how its lens bends, what the tool weighs; dated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from hal.arrays import Array
from hal.geometry import UncertainPose, transform_rpy
from hal.strict import Strict, load_toml

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
CORRELATIONS = 15  # of six axes with one another
ROUNDING = 1e-4  # of correlations that a person or a file has rounded


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraIntrinsics:
    """Pinhole with the radial-tangential model of Brown and Conrady.

    `u = fx x_d + cx` with `x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, x = X/Z.
    OpenCV's order of `distortion`: (k1, k2, p1, p2, k3). Camera axes: x right, y down, z along the
    view. Pixel (0, 0) is a pixel's centre.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ToolLoad:
    """What hangs below the force/torque sensor, in sensor axes: mass, centre of mass and the sensor's bias."""

    mass_kg: float
    centre_of_mass_m: Vector3
    bias: Vector6  # fx, fy, fz in N, then tx, ty, tz in N m


class MountRecord(Strict):
    """Pose of a device on its parent: fixed-axis roll, pitch, yaw, and one sigma for each of the six axes.

    `correlations` are those of the six (x, y, z, turns about x, y, z): the lower triangle, row by row, without the
    diagonal; empty: there are none.
    """

    position_m: Vector3
    rpy_rad: Vector3
    sigma_m: Vector3 = (0.0, 0.0, 0.0)
    sigma_rad: Vector3 = (0.0, 0.0, 0.0)
    correlations: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _is_a_covariance(self) -> MountRecord:
        if len(self.correlations) not in (0, CORRELATIONS):
            raise ValueError(
                f"correlations are {CORRELATIONS} numbers, a lower triangle; here are {len(self.correlations)}"
            )
        if np.linalg.eigvalsh(self._correlation_matrix())[0] < -ROUNDING:
            raise ValueError("no six axes can be correlated like this: the matrix has a negative eigenvalue")
        return self

    def pose(self) -> UncertainPose:
        """`parent_from_device` with its covariance."""
        sigma = np.array([*self.sigma_m, *self.sigma_rad])
        return UncertainPose(
            parent_from_child=transform_rpy(self.position_m, self.rpy_rad),
            covariance=self._correlation_matrix() * np.outer(sigma, sigma),
        )

    def _correlation_matrix(self) -> Array:
        lower = np.zeros((6, 6))
        if self.correlations:
            lower[np.tril_indices(6, -1)] = self.correlations
        return np.eye(6) + lower + lower.T


class IntrinsicsRecord(Strict):
    """Lens and image geometry of a camera."""

    width_px: Annotated[int, Field(ge=1, le=16384)]
    height_px: Annotated[int, Field(ge=1, le=16384)]
    fx_px: Annotated[float, Field(gt=0)]
    fy_px: Annotated[float, Field(gt=0)]
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rms_px: Annotated[float, Field(ge=0)] = 0.0
    sigma_focal_ratio: Annotated[float, Field(ge=0, lt=0.1)] = 0.0
    sigma_centre_px: Annotated[float, Field(ge=0)] = 0.0
    sigma_k1: Annotated[float, Field(ge=0)] = 0.0

    def one_sigma_lenses(self) -> tuple[CameraIntrinsics, ...]:
        """The lens with each of its independent errors one sigma large: focal length, centre x, centre y, k1."""
        lens = self.intrinsics()
        k1, k2, p1, p2, k3 = lens.distortion
        longer = 1.0 + self.sigma_focal_ratio
        return (
            replace(lens, fx_px=lens.fx_px * longer, fy_px=lens.fy_px * longer),
            replace(lens, cx_px=lens.cx_px + self.sigma_centre_px),
            replace(lens, cy_px=lens.cy_px + self.sigma_centre_px),
            replace(lens, distortion=(k1 + self.sigma_k1, k2, p1, p2, k3)),
        )

    def intrinsics(self) -> CameraIntrinsics:
        """The value type that perception computes with."""
        return CameraIntrinsics(
            **self.model_dump(exclude={"rms_px", "sigma_focal_ratio", "sigma_centre_px", "sigma_k1"})
        )


class LoadRecord(Strict):
    """Tool weight and force/torque bias."""

    mass_kg: Annotated[float, Field(ge=0)]
    centre_of_mass_m: Vector3
    bias_force_n: Vector3 = (0.0, 0.0, 0.0)
    bias_torque_nm: Vector3 = (0.0, 0.0, 0.0)

    def load(self) -> ToolLoad:
        """The value type that motion computes with."""
        return ToolLoad(
            mass_kg=self.mass_kg,
            centre_of_mass_m=self.centre_of_mass_m,
            bias=(*self.bias_force_n, *self.bias_torque_nm),
        )


class CalibrationRecord(Strict):
    """One calibration file: what was found for one device, when and how well."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    device: str
    version: Annotated[int, Field(ge=1)] = 1
    date: str
    method: str
    mount: MountRecord | None = None
    intrinsics: IntrinsicsRecord | None = None
    load: LoadRecord | None = None
    quality: dict[str, float] = {}


def load_calibration(path: Path) -> CalibrationRecord:
    """Read one record.

    Raises:
        ConfigError: missing or malformed file, with key path.
    """
    return load_toml(path, CalibrationRecord, "calibration record")
