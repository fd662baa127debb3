"""Analysis of one range image: from depth to surfaces with parameters and covariance."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from hal.arrays import Array, Labels
from hal.errors import InvalidRequest, NotFound
from hal.jit import compiled
from perception.range.features import RangeFeature, features_of
from perception.range.noise import NoiseModel, estimate_noise, typical_depths_m
from perception.range.primitives import Plane, Surface, SurfaceType
from perception.range.segmentation import finish, join, merge
from perception.range.segmentation.fillets import without_fillets
from perception.range.segmentation.model_selection import Candidates
from perception.range.segmentation.pixel_assignment import fill_small_gaps
from perception.range.segmentation.regions import Regions, regions_of
from perception.range.segmentation.segment import Task, icm_labels, segment
from perception.range.sensor import RangeSensorModel
from perception.range.straight import doubt_about

LEAST_VALID_PIXELS = 16
ICM_SWEEPS = 4
LEAST_KEPT_PIXELS = 8
CRUMB_SHARE = 0.5  # least pixels of a surface in the result, relative to the smallest that is searched for
LARGEST_PIXELS = 2**26  # 8192 x 8192 pixels; their analysis takes up to 6.0 GB of memory (measured)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeScene:
    """The surfaces that one range image shows.

    Attributes:
        labels: (H, W) int32, label of the surface at each pixel, 0 = none.
        surfaces: largest first, parameters in the sensor frame; `surfaces[i].label` is a value of `labels`.
        noise: the noise model that was estimated from the image, or given.
        sensor: the sensor model used.
        warnings: sentences about what limits the accuracy or completeness of this result.
    """

    labels: Labels
    surfaces: tuple[Surface, ...]
    noise: NoiseModel
    sensor: RangeSensorModel
    warnings: tuple[str, ...]

    def features(self) -> tuple[RangeFeature, ...]:
        """Return one feature per surface (plane, axis or point) with covariance, for fusion."""
        return features_of(self.surfaces)

    def of_type(self, kind: SurfaceType) -> tuple[Surface, ...]:
        """Return the surfaces of one type, largest first."""
        return tuple(s for s in self.surfaces if s.type == kind)

    def largest_plane(self) -> Surface:
        """Return the plane with the most pixels.

        Raises:
            NotFound: the image shows no plane.
        """
        for surface in self.surfaces:
            if isinstance(surface.primitive, Plane):
                return surface
        raise NotFound("the range image shows no plane", hint="move closer, or check the sensor model and its scale")


def analyse(
    depth_m: ArrayLike,
    sensor: RangeSensorModel,
    *,
    noise: NoiseModel | None = None,
    tiles: int = 1,
    pool: ThreadPoolExecutor | None = None,
) -> RangeScene:
    """Segment a range image into planes, spheres, cylinders, cones and ellipsoids, with parameters and covariance.

    Args:
        depth_m: (H, W) depth along the sensor's z axis, metres; NaN, infinite or <= 0 (pinhole) = no reading.
        sensor: pinhole or orthographic model of that size.
        noise: noise model to use instead of an estimate from the image.
        tiles: number of horizontal tiles in which pixels are processed; the result does not depend on it.
        pool: threads that process the tiles.

    Raises:
        InvalidRequest: wrong shape or type, a sensor of another size, or depth that cannot be metres.
        NotFound: fewer than 16 valid pixels.
    """
    depth, depths = checked_depth(depth_m, sensor)
    law = noise or estimate_noise(depth, sensor, depths_m=depths)
    task = Task(depth_m=depth, sensor=sensor, depths_m=depths, tiles=tiles, pool=pool)
    labels, found, law = segment(task, law)
    labels, surfaces = _finished(task, law, _grouped(task, law, labels, found), found)
    return RangeScene(
        labels=labels,
        surfaces=surfaces,
        noise=law,
        sensor=sensor,
        warnings=_warnings(depth, float(depths[2]), sensor, law, surfaces),
    )


def checked_depth(depth_m: ArrayLike, sensor: RangeSensorModel) -> tuple[Array, Array]:
    """Return the depth image as (H, W) float64, with NaN for every missing reading, and its `typical_depths_m`.

    Raises the same errors as `analyse`.
    """
    raw = np.asarray(depth_m)
    if raw.ndim != 2 or raw.dtype.kind not in "fiu":
        raise InvalidRequest(
            f"depth must be one (H, W) image of numbers, not shape {raw.shape} of {raw.dtype}",
            hint="pass one channel; convert integer codes with window.decode",
        )
    if raw.shape != (sensor.height_px, sensor.width_px):
        raise InvalidRequest(
            f"depth is {raw.shape[1]}x{raw.shape[0]} but the sensor model is {sensor.width_px}x{sensor.height_px}",
            hint="use the calibration of this resolution",
        )
    if raw.size > LARGEST_PIXELS:
        raise InvalidRequest(f"image of {raw.size} pixels", hint=f"at most {LARGEST_PIXELS} pixels; cut it into parts")
    depth = np.array(raw, dtype=np.float64, order="C")
    valid = int(_drop_missing(depth, -np.inf if sensor.packed()[0] == 0 else 0.0))
    if valid < LEAST_VALID_PIXELS:
        raise NotFound(
            f"only {valid} of {depth.size} pixels hold a depth", hint="check range, exposure and the invalid value"
        )
    depths = typical_depths_m(depth)
    _check_scale(float(depths[2]), sensor)
    return depth, depths


@compiled
def _drop_missing(depth: Array, least: float) -> int:
    """Replace readings that are not finite or not above `least` by NaN; returns the number of readings that remain."""
    flat = depth.ravel()
    valid = 0
    for i in range(flat.shape[0]):
        if np.isfinite(flat[i]) and flat[i] > least:
            valid += 1
        else:
            flat[i] = np.nan
    return valid


def _check_scale(middle: float, sensor: RangeSensorModel) -> None:
    """Raise InvalidRequest if the median depth shows that the image is not in metres."""
    if abs(middle) > 200.0:
        raise InvalidRequest(
            f"median depth is {middle:.0f} m: the image is probably in millimetres",
            hint="divide by 1000, or say the scale of a unit (--scale 0.001)",
            median_depth_m=middle,
        )
    if sensor.packed()[0] > 0 and middle < 1e-3:
        raise InvalidRequest(
            f"median depth is {middle:.2g} m: the scale is wrong", hint="give depth in metres", median_depth_m=middle
        )


def _grouped(task: Task, noise: NoiseModel, labels: Labels, found: Candidates) -> Regions:
    """Build the regions of the labels after touching parts and separated pieces of one surface have been merged."""
    packed, law = task.packed, noise.packed()
    regions = regions_of(task.depth_m, packed, law, labels, len(found.kinds))
    regions = regions.given_to(merge.merge_touching(regions, found.kinds, found.parameters))
    return regions.given_to(join.join_pieces(regions, found.kinds, found.parameters))


def _finished(task: Task, noise: NoiseModel, regions: Regions, found: Candidates) -> tuple[Labels, tuple[Surface, ...]]:
    """Refine all surfaces on their pixels, largest first, assign the pixels at borders, and drop tiny surfaces."""
    depth, packed, law = task.depth_m, task.packed, noise.packed()
    pixels = regions.pixels
    keep = sorted((k for k, n in enumerate(pixels, 1) if n >= LEAST_KEPT_PIXELS), key=lambda k: -pixels[k - 1])
    surfaces, ths = finish.refine_surfaces(keep, found.kinds, found.parameters, regions, noise)
    final = Candidates([found.kinds[k - 1] for k in keep], ths)
    names = np.zeros(len(pixels) + 1, np.int32)
    names[keep] = np.arange(1, len(keep) + 1)
    labels = icm_labels(task, noise, regions.renamed(names), final, sweeps=ICM_SWEEPS)
    labels = without_fillets(depth, packed, law, labels, *final.arrays())
    labels, surfaces = finish.without_crumbs(labels, surfaces, max(LEAST_KEPT_PIXELS, CRUMB_SHARE * task.least_pixels))
    fill_small_gaps(labels, depth, 2)
    return labels, tuple(surfaces)


def _warnings(
    depth: Array, middle: float, sensor: RangeSensorModel, noise: NoiseModel, surfaces: tuple[Surface, ...]
) -> tuple[str, ...]:
    """Return a sentence for each finding that makes the result less reliable."""
    doubt = doubt_about(depth, sensor)
    out = [] if doubt is None else [f"the sensor model seems wrong: {doubt}"]
    sigma = noise.sigma_of(middle)
    if sigma > 2.0 * sensor.pitch_m(middle):
        out.append(f"noise of {1e3 * sigma:.1f} mm exceeds two pixels: small surfaces are lost")
    if noise.is_stepped:
        out.append("depth comes in steps coarser than the noise: reprogram the sensor window if it allows")
    if not surfaces:
        out.append("no primitive explains any part of the image: check the sensor model and the scale")
    return tuple(out)
