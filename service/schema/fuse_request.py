"""The body of `fuse`: measurements of nine kinds, and objects whose own measures are unknown.

Each body turns itself into what `fusion` takes, which is imported only then: the service is up fast.
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

    sensing: Annotated[SENSING, Field(description="sensor feature, then object feature")]
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
        str, Field(max_length=41, description="part of `shape` that was sensed; then x_m and u are ignored")
    ] = ""

    def measurement(self) -> Measurement:
        """The same as fusion takes it.

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


Sigma = Annotated[float, Field(gt=0.0, le=10.0, description="standard deviation of what is believed beforehand, m")]
Size = Annotated[float, Field(gt=0.0, le=100.0)]


class CylinderBody(Strict):
    """A post along its z axis, foot at z = 0; parts `wall` and `top`. Radius and length are estimated, m."""

    kind: Literal["cylinder"]
    radius_m: Size
    length_m: Size
    sigma_m: Sigma = 0.02

    def shape(self) -> Cylinder:
        """The same as fusion takes it."""
        from fusion import Cylinder

        return Cylinder(radius_m=self.radius_m, length_m=self.length_m, sigma_m=self.sigma_m)


class BoxBody(Strict):
    """A box about its origin; parts are the faces `+x` to `-z` and edges such as `+x+z`. Its three sizes are estimated, m."""

    kind: Literal["box"]
    size_m: tuple[Size, Size, Size]
    sigma_m: Sigma = 0.02

    def shape(self) -> Box:
        """The same as fusion takes it."""
        from fusion import Box

        return Box(size_m=self.size_m, sigma_m=self.sigma_m)


class ParameterBody(Strict):
    """A measure of the object that is to be estimated, m."""

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
        """The same as fusion takes it, with a slope for each of the parameters.

        Raises:
            InvalidRequest: a line or plane without direction.
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
    """Any points, lines and planes whose places depend linearly on parameters, all of which are estimated."""

    kind: Literal["features"]
    parameters: Annotated[tuple[ParameterBody, ...], Field(min_length=1, max_length=20)]
    parts: Annotated[tuple[MovingPartBody, ...], Field(min_length=1, max_length=200)]

    @model_validator(mode="after")
    def _slopes_name_parameters(self) -> FeatureSetBody:
        known = {p.name for p in self.parameters}
        for part in self.parts:
            if unknown := set(part.slopes) - known:
                raise ValueError(f"part {part.name!r} depends on {sorted(unknown)}, which is no parameter")
        return self

    def shape(self) -> FeatureSet:
        """The same as fusion takes it.

        Raises:
            InvalidRequest: a line or plane without direction.
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
    """Fuse measurements into one pose: those given, or those that the cell collects itself."""

    model_config = ConfigDict(json_schema_extra={"examples": FUSE_EXAMPLES})

    measurements: Annotated[tuple[MeasurementBody, ...], Field(max_length=10_000)] = ()
    collect: Annotated[bool, Field(description="look, scan, touch and measure distances first")] = False
    touches: Touches = 4
    wanted: WantedPose = WantedPose()
    prior: PoseBody | None = None
    certify: Annotated[bool, Field(description="prove global optimality by a semidefinite relaxation")] = False
    prove_set_within_s: Annotated[
        float | None,
        Field(gt=0.0, le=60.0, description="prove by branch and bound which of at most 16 measurements to believe, s"),
    ] = None
    shape: Annotated[
        ShapeBody | None, Field(description="the object's own measures are estimated too; needs `prior`")
    ] = None

    @model_validator(mode="after")
    def _has_something_to_fuse(self) -> FuseRequest:
        if not self.measurements and not self.collect:
            raise ValueError("give measurements, or collect = true")
        if self.collect and (self.measurements or self.shape is not None):
            raise ValueError("collect = true takes neither measurements nor a shape")
        if self.shape is not None and self.prior is None:
            raise ValueError("a shape needs `prior`, a believed pose to start from")
        if self.shape is not None and (self.certify or self.prove_set_within_s is not None):
            raise ValueError("nothing is proven about a shape: leave out certify and prove_set_within_s")
        if self.shape is None and any(m.part for m in self.measurements):
            raise ValueError("a measurement names a part, but there is no shape")
        return self
