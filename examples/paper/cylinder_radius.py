"""Measures the radius of a post from touches, with the same fusion that finds the pose of a panel.

    python -m examples.paper.cylinder_radius

A post of unknown radius and length is measured by touch and range sensors at points spread over its wall and top; two
touches hit something else. `fuse` is called with a shape instead of fixed features and returns pose, radius and length
with their standard deviations. The second example is a post of which only a third of the wall can be reached, with a
quarter of the points wrong; the third is a box.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion import Box, Cylinder, FusedPose, Measurement, Shape, features, fuse, sensing
from hal.arrays import Array
from hal.geometry import UncertainPose, certain, perturbed, transform_rpy

TOUCH_SIGMA_M, RANGE_SIGMA_M, ARC_SIGMA_M = 0.0002, 0.002, 0.0008
BASE = certain(RigidTransform.identity())  # points are given in the base frame
PRIOR_SIGMA = np.array([0.005] * 3 + [0.02] * 3)  # uncertainty of the camera's pose: 5 mm, 1.1 degrees


def sensed_point(
    shape: Shape,
    part: str,
    on_object_m: Array,
    base_from_object: RigidTransform,
    sigma_m: float,
    rng: np.random.Generator,
) -> Measurement:
    """Return a noisy point on `part`, as a touch or range sensor measures it, as a point-plane measurement."""
    feature = shape.feature(part, shape.start, on_object_m)
    seen = base_from_object.apply(on_object_m) + rng.normal(0.0, sigma_m, 3)
    label = f"{part} {1e3 * sigma_m:.1f} mm"
    made = sensing.range_point(feature, BASE, point_m=seen, covariance_m2=sigma_m**2 * np.eye(3), label=label)
    return replace(made, part=part)


def believed(base_from_object: RigidTransform, rng: np.random.Generator) -> UncertainPose:
    """Return the pose as the camera would estimate it: the true one with noise, and its covariance."""
    return UncertainPose(
        parent_from_child=perturbed(base_from_object, rng.normal(0.0, PRIOR_SIGMA)), covariance=np.diag(PRIOR_SIGMA**2)
    )


def cylinder_case(seed: int = 0) -> tuple[FusedPose, Cylinder]:
    """Fuse 15 touches, two of them wrong, with 20 range points on a post; return the result and the true post."""
    rng = np.random.default_rng(seed)
    true, guess = Cylinder(radius_m=0.0312, length_m=0.118), Cylinder(radius_m=0.025, length_m=0.10)
    base_from_post = transform_rpy((0.7, 0.1, 0.4), (0.3, -0.4, 1.0))

    def place(part: str) -> Array:
        angle, height, share = rng.uniform(0, 2 * np.pi), rng.uniform(0.01, 0.11), rng.uniform(0, 0.9)
        r = true.radius_m * (share if part == "top" else 1.0)
        return np.array([r * np.cos(angle), r * np.sin(angle), true.length_m if part == "top" else height])

    touches = [
        sensed_point(guess, part, place(part), base_from_post, TOUCH_SIGMA_M, rng)
        for part in ["wall"] * 8 + ["top"] * 4
    ]
    ranged = [
        sensed_point(guess, part, place(part), base_from_post, RANGE_SIGMA_M, rng)
        for part in ["wall"] * 14 + ["top"] * 6
    ]
    table = features.plane(
        (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), name="table"
    )  # fixed feature: the length of the post is measured from here
    foot = [
        sensing.range_point(
            table, BASE, point_m=base_from_post.apply([x, y, 0.0]) + rng.normal(0.0, TOUCH_SIGMA_M, 3),
            covariance_m2=TOUCH_SIGMA_M**2 * np.eye(3), label="table",
        )
        for x, y in ((0.06, 0.0), (-0.04, 0.05), (-0.03, -0.06))
    ]  # fmt: skip
    for k in (3, 9):  # the finger touched a cable, 12 mm in front of the surface
        m = touches[k]
        normal = guess.feature(m.part, guess.start, base_from_post.inv().apply(m.mu_m)).direction
        touches[k] = replace(m, mu_m=m.mu_m + 0.012 * base_from_post.rotation.apply(normal), label="cable")
    return fuse([*touches, *ranged, *foot], prior=believed(base_from_post, rng), shape=guess), true


def arc_case(seed: int = 0) -> tuple[FusedPose, Cylinder]:
    """Fuse 40 range points from one side of a post, ten of them wrong; return the result and the true post.

    They cover 120 degrees of the wall; over so short an arc, radius and axis position are strongly correlated.
    """
    rng = np.random.default_rng(seed)
    true, guess = Cylinder(radius_m=0.0405, length_m=0.15), Cylinder(radius_m=0.03, length_m=0.15, sigma_m=0.03)
    base_from_post = transform_rpy((0.6, -0.1, 0.3), (0.2, 0.1, -0.5))
    points = []
    for k in range(40):
        angle, height = rng.uniform(-np.pi / 3, np.pi / 3), rng.uniform(0.01, 0.14)
        on_wall = np.array([true.radius_m * np.cos(angle), true.radius_m * np.sin(angle), height])
        point = sensed_point(guess, "wall", on_wall, base_from_post, ARC_SIGMA_M, rng)
        if k % 4 == 0:  # a cable in front of the post, or the background behind its edge
            stray = base_from_post.rotation.apply([rng.choice([0.015, 0.025, -0.02]), 0.0, 0.0])
            point = replace(point, mu_m=point.mu_m + stray, label="cable")
        points.append(point)
    return fuse(points, prior=believed(base_from_post, rng), shape=guess), true


def box_case(seed: int = 0) -> tuple[FusedPose, Box]:
    """Fuse three touches on each face of a box that is 10 mm larger than assumed; return the result and the truth."""
    rng = np.random.default_rng(seed)
    true, guess = Box(size_m=(0.25, 0.20, 0.06)), Box(size_m=(0.24, 0.19, 0.05))
    base_from_box = transform_rpy((0.8, -0.2, 0.5), (0.1, 0.2, -0.7))
    half = np.array(true.size_m) / 2
    touches = []
    for part in ("+x", "-x", "+y", "-y", "+z", "-z"):
        k = "xyz".index(part[1])
        for _ in range(3):
            on_face = rng.uniform(-0.8, 0.8, 3) * half
            on_face[k] = half[k] if part[0] == "+" else -half[k]
            touches.append(sensed_point(guess, part, on_face, base_from_box, TOUCH_SIGMA_M, rng))
    return fuse(touches, prior=believed(base_from_box, rng), shape=guess), true


def report(title: str, answer: FusedPose, true: Shape) -> str:
    """Return the estimated values with their standard deviations beside the true ones, as text."""
    assert answer.shape is not None  # noqa: S101 - `fuse` fills it whenever a shape was given
    lines = [title]
    for name, truth in zip(answer.shape.names, true.start, strict=True):
        value, sigma = answer.shape.value_of(name), answer.shape.sigma_of(name)
        lines.append(f"  {name:<10} {1e3 * value:8.3f} mm +- {1e3 * sigma:.3f}   true {1e3 * truth:8.3f}")
    lines.append(f"  chi-square {answer.chi_square:.1f} on {answer.dof}; not believed:")
    lines += [f"    {r.index:2d} {r.label}: {r.value:.0f}, limit {r.limit:.1f}" for r in answer.rejected] or [
        "    none"
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    print(report("post", *cylinder_case()))
    print(report("post from one side", *arc_case()))
    print(report("box", *box_case()))
