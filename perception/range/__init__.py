"""Range images to named surfaces with covariance, and surfaces to models (paper, Section III)."""

from perception.range.analyse import RangeScene, analyse
from perception.range.features import FeatureKind, RangeFeature
from perception.range.noise import NoiseModel, estimate_noise
from perception.range.plane import PlaneFit, fit_plane_near
from perception.range.primitives import Cone, Cylinder, Ellipsoid, Plane, Sphere, Surface, SurfaceType
from perception.range.sensor import OrthographicSensor, PinholeSensor, RangeSensorModel

__all__ = [
    "Cone",
    "Cylinder",
    "Ellipsoid",
    "FeatureKind",
    "NoiseModel",
    "OrthographicSensor",
    "PinholeSensor",
    "Plane",
    "PlaneFit",
    "RangeFeature",
    "RangeScene",
    "RangeSensorModel",
    "Sphere",
    "Surface",
    "SurfaceType",
    "analyse",
    "estimate_noise",
    "fit_plane_near",
]
