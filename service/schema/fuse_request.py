"""The body of `fuse`: measurements of nine kinds, and objects with unknown dimensions.

Each model converts itself to the types of `fusion`, which is imported only then, so that the service starts fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from hal.strict import Strict
from service.schema.examples import FUSE_EXAMPLES
from service.schema.requests import Length, ObjectName, Point, PoseBody, Row3, Touches, Vector3, WantedPose

if TYPE_CHECKING:
    from fusion import Box, Cylinder, FeatureSet, Measurement, MovingPart

SENSING = Literal[
    "point-point", "point-line", "point-plane", "line-point", "line-line", "line-plane", "plane-point", "plane-line",
    "plane-plane",
]  # fmt: skip


class MeasurementBody(Strict):
    """One sensing of one object feature (paper, section IV): `g(y, v) = (y - mu)^T C^-1 (y - mu) + v^T M v`."""

    sensing: Annotated[SENSING, Field(description="kind of the sensed feature, then of the object feature")]
    x_m: Annotated[Point, Field(description="point of the object feature, object frame")]
    u: Annotated[Vector3, Field(description="unit direction or normal of the object feature")] = (0.0, 0.0, 1.0)
    mu_m: Annotated[Point, Field(description="sensed point, or a point of the sensed line or plane, base frame")]
    c_m2: Annotated[Row3, Field(description="covariance of mu, m^2")]
    m_per_rad2: Annotated[Row3, Field(description="information of the sensed direction, 1/rad^2; null along it")] = (
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
        (0.0, 0.0, 0.0),
    )
    label: Annotated[str, Field(max_length=80)] = ""
    sensor: Annotated[str, Field(max_length=80)] = ""
    part: Annotated[
        str, Field(max_length=41, description="part of `shape` that was sensed; if given, x_m and u are ignored")
    ] = ""

    def measurement(self) -> Measurement:
        """Convert to a `fusion.Measurement`.

        Raises:
            InvalidRequest: see `fusion.Measurement`.
        """
        from fusion import Feature, Kind, Measurement, SensingClass

        cls = SensingClass.named(self.sensing)
        kind = list(Kind)[(cls - 1) % 3]
        feature = Feature(kind=kind, point_m=np.array(self.x_m), direction=np.array(self.u), name="")
        return Measurement(
            cls=cls,
            x_m=feature.point_m,
            u=feature.direction,
            mu_m=np.array(self.mu_m),
            C_m2=np.array(self.c_m2),
            M=np.array(self.m_per_rad2),
            label=self.label,
            sensor=self.sensor,
            part=self.part,
        )


Sigma = Annotated[float, Field(gt=0.0, le=10.0, description="standard deviation of the prior value, m")]
Size = Annotated[float, Field(gt=0.0, le=100.0)]


class CylinderBody(Strict):
    """A post along z that stands on z = 0, with the parts `wall` and `top`. Radius and length are estimated, m."""

    kind: Literal["cylinder"]
    radius_m: Size
    length_m: Size
    sigma_m: Sigma = 0.02

    def shape(self) -> Cylinder:
        """Convert to the shape of `fusion`."""
        from fusion import Cylinder

        return Cylinder(radius_m=self.radius_m, length_m=self.length_m, sigma_m=self.sigma_m)


class BoxBody(Strict):
    """A box about its origin, with faces `+x` to `-z` and edges such as `+x+z`. Its three sizes are estimated, m."""

    kind: Literal["box"]
    size_m: tuple[Size, Size, Size]
    sigma_m: Sigma = 0.02

    def shape(self) -> Box:
        """Convert to the shape of `fusion`."""
        from fusion import Box

        return Box(size_m=self.size_m, sigma_m=self.sigma_m)


class ParameterBody(Strict):
    """A dimension of the object that is to be estimated, m."""

    name: ObjectName
    start_m: Length
    sigma_m: Sigma = 0.02


class MovingPartBody(Strict):
    """A feature whose point is `point_m + sum slope * parameter`; slopes are by parameter name, without unit."""

    name: ObjectName
    feature: Literal["point", "line", "plane"]
    point_m: Point
    direction: Vector3 = (0.0, 0.0, 1.0)
    slopes: Annotated[dict[str, Vector3], Field(max_length=20)] = {}

    def moving(self, parameters: tuple[str, ...]) -> MovingPart:
        """Convert to a `fusion.shapes.MovingPart`, with a slope for each of the parameters.

        Raises:
            InvalidRequest: a line or plane has no direction.
        """
        from fusion import Feature, Kind, MovingPart, unit

        return MovingPart(
            feature=Feature(
                kind=Kind(self.feature),
                point_m=np.array(self.point_m),
                direction=unit(self.direction),
                name=self.name,
            ),
            slopes=np.array([self.slopes.get(name, (0.0, 0.0, 0.0)) for name in parameters]),
        )


class FeatureSetBody(Strict):
    """Points, lines and planes whose positions depend linearly on parameters, all of which are estimated."""

    kind: Literal["features"]
    parameters: Annotated[tuple[ParameterBody, ...], Field(min_length=1, max_length=20)]
    parts: Annotated[tuple[MovingPartBody, ...], Field(min_length=1, max_length=200)]

    @model_validator(mode="after")
    def _slopes_name_parameters(self) -> FeatureSetBody:
        known = {p.name for p in self.parameters}
        for part in self.parts:
            if unknown := set(part.slopes) - known:
                raise ValueError(f"part {part.name!r} depends on {sorted(unknown)}, which is not a parameter")
        return self

    def shape(self) -> FeatureSet:
        """Convert to the shape of `fusion`.

        Raises:
            InvalidRequest: a line or plane has no direction.
        """
        from fusion import FeatureSet

        names = tuple(p.name for p in self.parameters)
        return FeatureSet(
            names=names,
            start=np.array([p.start_m for p in self.parameters]),
            sigma=np.array([p.sigma_m for p in self.parameters]),
            moving={part.name: part.moving(names) for part in self.parts},
        )


ShapeBody = Annotated[CylinderBody | BoxBody | FeatureSetBody, Field(discriminator="kind")]


class FuseRequest(Strict):
    """Fuse measurements into one pose: the given ones, or those that the cell collects itself."""

    model_config = ConfigDict(json_schema_extra={"examples": FUSE_EXAMPLES})

    measurements: Annotated[tuple[MeasurementBody, ...], Field(max_length=10_000)] = ()
    collect: Annotated[
        bool, Field(description="collect the measurements first: images, range scan, touches and distances")
    ] = False
    touches: Touches = 4
    wanted: WantedPose = WantedPose()
    prior: PoseBody | None = None
    certify: Annotated[bool, Field(description="prove global optimality by a semidefinite relaxation")] = False
    prove_set_within_s: Annotated[
        float | None,
        Field(
            gt=0.0,
            le=60.0,
            description="prove by branch and bound, within this time, which of at most 16 measurements are inliers, s",
        ),
    ] = None
    shape: Annotated[ShapeBody | None, Field(description="estimate the object's dimensions too; needs `prior`")] = None

    @model_validator(mode="after")
    def _has_something_to_fuse(self) -> FuseRequest:
        if not self.measurements and not self.collect:
            raise ValueError("give measurements, or collect = true")
        if self.collect and (self.measurements or self.shape is not None):
            raise ValueError("collect = true takes neither measurements nor a shape")
        if self.shape is not None and self.prior is None:
            raise ValueError("a shape needs `prior`, a pose to start from")
        if self.shape is not None and (self.certify or self.prove_set_within_s is not None):
            raise ValueError("certify and prove_set_within_s are not possible with a shape")
        if self.shape is None and any(m.part for m in self.measurements):
            raise ValueError("a measurement names a part, but there is no shape")
        return self
