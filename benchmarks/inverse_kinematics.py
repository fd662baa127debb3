"""Measures the inverse kinematics of every simulated arm: `python -m benchmarks.inverse_kinematics [--poses N]`.

The poses are those of random joint vectors inside the limits. A pose is right if one solution is that joint vector and
every solution reaches the pose within 1e-9. For some poses, damped least squares from random starts look for a branch
that is missing. Times are CPU times of one thread, those of an arm that has a joint to spare for one value of it.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from hal.arrays import Array
from manipulation.arm import branches, kernels
from manipulation.arm.kinematics import SOLVED_JOINTS, Kinematics
from simbackend.arm_model import MODELS

WITHIN = 1e-9
FOUND_RAD = 1e-6
SEARCHED_POSES, STARTS = 200, 60
SEARCH_STEPS = 60
SINGULAR = 1e-3  # where branches meet, a search ends anywhere between them


def first_six(arm: Kinematics) -> Kinematics:
    """Return the arm without its free joint, which is fixed at the middle of its range."""
    if len(arm.dh) == SOLVED_JOINTS:
        return arm
    caps = arm.capabilities
    cut = {
        name: getattr(caps, name)[:SOLVED_JOINTS]
        for name in ("links", "lower_rad", "upper_rad", "velocity_rad_per_s", "acceleration_rad_per_s2")
    }
    return Kinematics.of(type(caps)(**{**{n: getattr(caps, n) for n in caps.__slots__}, **cut}))


def reached(arm: Kinematics, found: Array, pose: Array) -> float:
    """Return the largest error of the solutions (k, n) for a pose (4, 4)."""
    return max(float(np.abs(kernels.frames(arm.dh, q)[-1] - pose).max()) for q in found)


def missing(arm: Kinematics, q: Array, rng: np.random.Generator) -> int:
    """Return how many branches within the limits a search from random starts finds that the inverse lacks."""
    pose = arm.flange(q).as_matrix()
    known = arm._branches(pose, np.empty(0))
    starts = rng.uniform(arm.lower_rad, arm.upper_rad, (STARTS, len(q)))
    lost = 0
    for start in starts:
        found = kernels.follow_pose(arm.dh, np.eye(4), start, pose, 1e-2, SEARCH_STEPS)
        if np.abs(kernels.frames(arm.dh, found)[-1] - pose).max() > WITHIN or arm.conditioning(found) < SINGULAR:
            continue
        apart = np.abs((known - found + np.pi) % branches.TURN_RAD - np.pi).max(axis=1)
        lost += int(apart.min(initial=np.inf) > FOUND_RAD)
    return lost


def measure(name: str, arm: Kinematics, poses: int) -> str:
    """Return one row of the table."""
    rng = np.random.default_rng(20)
    samples = rng.uniform(arm.lower_rad, arm.upper_rad, (poses, len(arm.dh)))
    arm.inverse(arm.flange(samples[0]))
    times, right, count, worst = np.empty(poses), 0, 0, 0.0
    for i, q in enumerate(samples):
        pose = arm.flange(q)
        began_s = time.thread_time()
        found = arm.inverse(pose)
        times[i] = time.thread_time() - began_s
        error = reached(arm, found[:: max(1, len(found) // 16)], pose.as_matrix()) if len(found) else np.inf
        nearest = np.abs(found - q).max(axis=1).min(initial=np.inf)
        right += bool(error <= WITHIN and nearest <= FOUND_RAD)
        count, worst = count + len(found), max(worst, error)
    lost = sum(missing(arm, q, rng) for q in samples[:SEARCHED_POSES])
    median, high = 1e6 * np.quantile(times, [0.5, 0.99])
    return (
        f"{name:8} {right:7}/{poses:<7} {worst:9.1e} {count / poses:9.1f} {lost:8} {median:8.1f} {high:8.1f}  "
        f"{'pass' if right == poses and not lost and median <= 60.0 else 'FAIL'}"
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=100_000)
    options = parser.parse_args()
    print("arm      right/poses     worst error  solutions missing  us p50   us p99")
    for name, model in MODELS.items():
        print(measure(name, first_six(Kinematics.of(model().capabilities)), options.poses), flush=True)


if __name__ == "__main__":
    main()
