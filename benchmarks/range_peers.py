"""Third-party segmenters on the same images in the same run: Open3D and pyransac3d, if they are installed.

`pip install -e '.[bench]'` installs them. Each receives the points and returns labels and primitives, which are judged
by the same scorer.
"""

from __future__ import annotations

import importlib
import importlib.util
import random
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array

Labels = NDArray[np.int32]
Found = tuple[NDArray[np.bool_], dict[str, Any]]  # mask of the points, and the primitive in the scorer's format
Segmenter = Callable[[ModuleType, Array], Iterator[Found]]

THRESHOLD_MM = 2.0  # four sigmas of the nominal noise
LEAST_SHARE = 0.005  # smallest surface searched for, as a fraction of all points
MOST_SURFACES = 12
OPEN3D_TRIES, PYRANSAC_TRIES = 500, 60


@dataclass(frozen=True, slots=True, kw_only=True)
class PeerResult:
    """Result of a peer: correct regions at T = 0.8, all regions, and median time per image."""

    name: str
    correct: int
    regions: int
    ms: float


def peer_results(score: ModuleType, cases: Sequence[tuple[dict[str, Any], Array]]) -> list[PeerResult]:
    """Run every installed peer on every case: a case of the generator with its (H, W, 3) points in mm, NaN for none."""
    peers: tuple[tuple[str, str, Segmenter], ...] = (
        ("Open3D RANSAC planes", "open3d", _open3d_planes),
        ("Open3D planar patches", "open3d", _open3d_patches),
        ("pyransac3d, three kinds", "pyransac3d", _pyransac3d),
    )
    return [
        _judged(name, segmenter, importlib.import_module(module), score, cases)
        for name, module, segmenter in peers
        if importlib.util.find_spec(module) is not None
    ]


def _judged(
    name: str,
    segmenter: Segmenter,
    module: ModuleType,
    score: ModuleType,
    cases: Sequence[tuple[dict[str, Any], Array]],
) -> PeerResult:
    rows, times = [], []
    for case, points in cases:
        random.seed(0)  # used by pyransac3d
        started = time.perf_counter()
        labels, primitives = _labelled(segmenter, module, points)
        times.append(1e3 * (time.perf_counter() - started))
        rows.append(score.score_case(case, labels, primitives, 0.8, None))
    result = score.summarise(rows)["hoover"]["0.8"]
    return PeerResult(name=name, correct=result["correct"], regions=result["gt"], ms=float(np.median(times)))


def _labelled(segmenter: Segmenter, module: ModuleType, points: Array) -> tuple[Labels, list[dict[str, Any]]]:
    """Return labels of what a segmenter finds; a surface with several parts in the image is split into regions."""
    valid = np.isfinite(points).all(axis=2)
    labels = np.zeros(valid.shape, np.int32)
    primitives: list[dict[str, Any]] = []
    for inside, primitive in segmenter(module, points[valid]):
        mask = np.zeros(valid.shape, np.uint8)
        mask[valid] = inside
        count, parts = cv2.connectedComponents(mask)
        for part in range(1, count):
            region = (parts == part) & (labels == 0)
            if region.sum() >= LEAST_SHARE * valid.sum():
                primitives.append({**primitive, "id": len(primitives) + 1})
                labels[region] = len(primitives)
    return labels, primitives


def _greedy(points: Array, largest: Callable[[Array], tuple[NDArray[np.intp], dict[str, Any]]]) -> Iterator[Found]:
    """Yield the surface with the most points, then the largest of the remaining points, until few points remain."""
    left = np.arange(len(points))
    for _ in range(MOST_SURFACES):
        if len(left) < max(16, LEAST_SHARE * len(points)):
            return
        chosen, primitive = largest(points[left])
        if len(chosen) < LEAST_SHARE * len(points):
            return
        inside = np.zeros(len(points), np.bool_)
        inside[left[chosen]] = True
        left = np.delete(left, chosen)
        yield inside, primitive


def _open3d_planes(open3d: ModuleType, points: Array) -> Iterator[Found]:
    open3d.utility.random.seed(0)

    def largest(left: Array) -> tuple[NDArray[np.intp], dict[str, Any]]:
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(left))
        plane, chosen = cloud.segment_plane(THRESHOLD_MM, 3, OPEN3D_TRIES)
        return np.asarray(chosen, np.intp), _plane(np.asarray(plane))

    return _greedy(points, largest)


def _open3d_patches(open3d: ModuleType, points: Array) -> Iterator[Found]:
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.estimate_normals(open3d.geometry.KDTreeSearchParamKNN(30))
    for box in cloud.detect_planar_patches():
        normal, middle = np.asarray(box.R)[:, 2], np.asarray(box.center)
        inside = np.zeros(len(points), np.bool_)
        inside[box.get_point_indices_within_bounding_box(cloud.points)] = True
        yield inside, {"type": "plane", "n": normal.tolist(), "c": middle.tolist()}


def _pyransac3d(pyransac3d: ModuleType, points: Array) -> Iterator[Found]:
    def sphere(fit: Any) -> dict[str, Any]:
        return {"type": "sphere", "c": list(fit.center), "r": float(fit.radius)}

    def cylinder(fit: Any) -> dict[str, Any]:
        return {"type": "cylinder", "c": list(fit.center), "axis": list(fit.axis), "r": float(fit.radius)}

    def plane(fit: Any) -> dict[str, Any]:
        return _plane(np.asarray(fit.equation))

    kinds = ((pyransac3d.Plane, plane), (pyransac3d.Sphere, sphere), (pyransac3d.Cylinder, cylinder))

    def largest(left: Array) -> tuple[NDArray[np.intp], dict[str, Any]]:
        fits = []
        for kind, primitive in kinds:
            fit = kind()
            fit.fit(left, thresh=THRESHOLD_MM, maxIteration=PYRANSAC_TRIES)
            fits.append((np.asarray(fit.inliers, np.intp), fit, primitive))
        chosen, fit, primitive = max(fits, key=lambda found: len(found[0]))
        return chosen, primitive(fit) if len(chosen) else {}

    return _greedy(points, largest)


def _plane(equation: Array) -> dict[str, Any]:
    """Return the plane (4,) a, b, c, d with a x + b y + c z + d = 0 in the scorer's format."""
    normal = equation[:3]
    return {"type": "plane", "n": normal.tolist(), "c": (-equation[3] * normal / (normal @ normal)).tolist()}
