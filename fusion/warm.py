"""Compiles or loads the fast loops before the first caller would wait for them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.certify.dual import minimiser
from fusion.certify.proof import quadratic_forms
from fusion.features import Kind, box_features
from fusion.measurement import Measurement, measurement
from fusion.robust import fuse, used_entries
from fusion.shared_errors import linearised
from fusion.solve import solve
from hal.geometry import UncertainPose

SIGMA_M, SIGMA_RAD = 0.001, 0.002


def warm_up() -> None:
    """Run one small problem of every class: minutes after a change of the code, milliseconds from the cache."""
    made, pose = one_of_each_class(), RigidTransform.identity()
    solve(made, pose)
    linearised(made, pose)
    prior = UncertainPose(parent_from_child=pose, covariance=1e-4 * np.eye(6))
    fuse(made, prior=prior)
    fuse([min(made, key=lambda one: one.dof)], prior=prior)  # where many poses fit, all are looked for
    b, _, local = used_entries(made, fuse(made))
    forms = quadratic_forms(b, local.rotation, local.translation_m, np.zeros(3), np.zeros(3), 1.0)
    minimiser(forms.sum(axis=0), local.rotation, local.translation_m)


def one_of_each_class() -> list[Measurement]:
    """Return noise-free measurements of a box in the base frame: each kind sensed of each kind of feature."""
    box = box_features((0.0, 0.0, 0.0), (0.3, 0.2, 0.1))
    made = []
    for sensed in Kind:
        for kind in Kind:
            for feature in [f for f in box if f.kind == kind][::4]:
                along = feature.direction
                if kind not in (sensed, Kind.POINT):  # a line in a plane, a plane through a line
                    along = np.roll(along, 1)
                M = np.zeros((3, 3)) if sensed == Kind.POINT else (np.eye(3) - np.outer(along, along)) / SIGMA_RAD**2
                made.append(measurement(feature, sensed, mu_m=feature.point_m, C_m2=SIGMA_M**2 * np.eye(3), M=M))
    return made
