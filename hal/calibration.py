"""Calibration records: pose of a mounted device, camera intrinsics, tool load; each with date, method and quality."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hal.arrays import Array
from hal.errors import InvalidRequest
from hal.geometry import UncertainPose, transform_rpy
from hal.strict import Strict, load_toml

Vector3 = tuple[float, float, float]
Vector6 = tuple[float, float, float, float, float, float]
CORRELATIONS = 15  # pairs of six axes
ROUNDING = 1e-4  # tolerance for correlations that were rounded in the file


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraIntrinsics:
    """Intrinsics of a pinhole camera with the radial-tangential lens model of Brown and Conrady.

    `u = fx x_d + cx` with `x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, x = X/Z.
    `distortion` is in OpenCV's order (k1, k2, p1, p2, k3). Camera axes: x right, y down, z along the view. The integer
    coordinates (0, 0) are the centre of the upper left pixel.
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
    """Load on the force/torque sensor, in sensor axes: mass and centre of mass of the tool, and the sensor's bias."""

    mass_kg: float
    centre_of_mass_m: Vector3
    bias: Vector6  # fx, fy, fz in N, then tx, ty, tz in N m


class MountRecord(Strict):
    """Pose of a device in its parent frame: position, fixed-axis roll, pitch and yaw, and one sigma for each axis.

    `correlations` holds the correlations of the six axes (x, y, z, rotations about x, y, z): the lower triangle of
    their matrix, row by row, without the diagonal; empty means that there are none.
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
                f"correlations must be {CORRELATIONS} numbers, a lower triangle, not {len(self.correlations)}"
            )
        if np.linalg.eigvalsh(self._correlation_matrix())[0] < -ROUNDING:
            raise ValueError(
                "correlations contradict each other: their matrix has a negative eigenvalue; check the numbers and their order"
            )
        return self

    def pose(self) -> UncertainPose:
        """Return `parent_from_device` with its covariance (see `hal.geometry`)."""
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
    """Intrinsics of a camera, with the RMS reprojection error of the calibration and the one-sigma uncertainties."""

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
        """Return the intrinsics with one parameter at a time off by one sigma: focal length, centre x, centre y, k1."""
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
        """Return the intrinsics as the value type that perception uses."""
        return CameraIntrinsics(
            **self.model_dump(exclude={"rms_px", "sigma_focal_ratio", "sigma_centre_px", "sigma_k1"})
        )


class LoadRecord(Strict):
    """Load of the tool on the force/torque sensor and bias of the sensor, in sensor axes."""

    mass_kg: Annotated[float, Field(ge=0)]
    centre_of_mass_m: Vector3
    bias_force_n: Vector3 = (0.0, 0.0, 0.0)
    bias_torque_nm: Vector3 = (0.0, 0.0, 0.0)

    def load(self) -> ToolLoad:
        """Return the load as the value type that manipulation uses."""
        return ToolLoad(
            mass_kg=self.mass_kg,
            centre_of_mass_m=self.centre_of_mass_m,
            bias=(*self.bias_force_n, *self.bias_torque_nm),
        )


class DepthBendRecord(Strict):
    """Slowly varying error of a range camera: what is added to the inverse depth (1/m) of its pixels.

    `per_m` are the values at the nodes of a grid over the image, row by row, bilinear between them; the nodes at the corners
    are the corner pixels.
    """

    width_px: Annotated[int, Field(ge=2, le=16384)]
    height_px: Annotated[int, Field(ge=2, le=16384)]
    per_m: Annotated[tuple[tuple[float, ...], ...], Field(min_length=2)]

    @model_validator(mode="after")
    def _is_a_grid(self) -> DepthBendRecord:
        widths = {len(row) for row in self.per_m}
        if len(widths) != 1 or min(widths) < 2:
            raise ValueError("per_m must have rows of one length, two or more numbers each")
        return self

    def straightened(self, depth_m: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Return a depth image (H, W) without the bend; NaN where nothing was measured.

        Raises:
            InvalidRequest: the image has another size than those by which the bend was measured.
        """
        if depth_m.shape != (self.height_px, self.width_px):
            raise InvalidRequest(
                f"the depth image has {depth_m.shape[1]}x{depth_m.shape[0]} px, its bend was measured for"
                f" {self.width_px}x{self.height_px}",
                hint="set the range camera's resolution back, or run `panelwright calibrate depth` again",
            )
        grid = np.array(self.per_m)
        field = bilinear_weights(self.height_px, len(grid)) @ grid @ bilinear_weights(self.width_px, grid.shape[1]).T
        return np.asarray(1.0 / (1.0 / depth_m + field), np.float32)


def bilinear_weights(pixels: int, nodes: int) -> Array:
    """Return the weights (pixels, nodes) of evenly spaced nodes, the outer ones at the first and the last pixel."""
    at = np.linspace(0.0, nodes - 1.0, pixels)
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(nodes))))


class CalibrationRecord(Strict):
    """Calibration file of one device: the results, their date, method and quality."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    device: str
    version: Annotated[int, Field(ge=1)] = 1
    date: str
    method: str
    to_measure: Annotated[
        tuple[Literal["mount", "intrinsics", "load"], ...],
        Field(description="parts that nobody has measured yet; a calibration takes its parts off the list"),
    ] = ()
    mount: MountRecord | None = None
    intrinsics: IntrinsicsRecord | None = None
    load: LoadRecord | None = None
    depth_bend: DepthBendRecord | None = None
    quality: dict[str, float] = {}


def load_calibration(path: Path) -> CalibrationRecord:
    """Read one record.

    Raises:
        ConfigError: missing or malformed file, with key path.
    """
    return load_toml(path, CalibrationRecord, "calibration record")
