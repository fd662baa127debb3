"""Random fusion problems, and statistics of the fusion over families of them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.fusion_simulation import CODES, Problem, problem
from fusion import FusedPose, Measurement, SensingClass, fuse
from fusion.errors import Contradiction
from fusion.solve import solve
from hal.arrays import Array
from hal.geometry import difference

NEAR_M, NEAR_RAD = 0.005, np.radians(1.0)


@dataclass(kw_only=True)
class Tally:
    """Statistics over a family of simulated problems."""

    count: int = 0
    near: int = 0
    refused: int = 0
    bad: int = 0
    named: int = 0
    good: int = 0
    dropped: int = 0
    nees: list[float] = field(default_factory=list)
    position: list[float] = field(default_factory=list)
    rotation: list[float] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    def add(self, made: Problem) -> FusedPose | None:
        """Solve one problem and add its result to the statistics."""
        self.count += 1
        started_s = time.process_time()
        try:
            answer = fuse(made.measurements)
        except Contradiction:
            self.refused += 1
            return None
        self.ms.append((time.process_time() - started_s) * 1e3)
        delta = difference(made.base_from_object, answer.pose)
        self.near += is_near(delta)
        named = set(mismatched(answer))
        self.bad, self.named = self.bad + len(made.bad), self.named + len(named & made.bad)
        self.good += len(made.measurements) - len(made.bad)
        self.dropped += len(named - made.bad)
        if not made.bad and not answer.unobservable:
            self.nees.append(float(delta @ np.linalg.solve(answer.covariance, delta)))
            bound = solve(made.measurements, made.base_from_object).covariance
            self.position.append(float(delta[:3] @ delta[:3] / np.trace(bound[:3, :3])))
            self.rotation.append(float(delta[3:] @ delta[3:] / np.trace(bound[3:, 3:])))
        return answer


def is_near(delta: Array) -> bool:
    """Return whether an error `delta` (6,), m and rad, is a success for the scorer: within 5 mm and 1 degree."""
    return bool(np.linalg.norm(delta[:3]) < NEAR_M and np.linalg.norm(delta[3:]) < NEAR_RAD)


def codes(rng: np.random.Generator, count: int) -> list[str]:
    """Return random kinds of sensing."""
    return [CODES[k] for k in rng.integers(len(CODES), size=count)]


def mixed(count: int, bad: int, problems: int, rng: np.random.Generator, *, anisotropy: float = 1.0) -> Tally:
    """Fuse `problems` random mixtures of `count` measurements of which `bad` are mismatched."""
    tally = Tally()
    for _ in range(problems):
        tally.add(problem(codes(rng, count), rng, bad=bad, anisotropy=anisotropy))
    return tally


def random_measurement(cls: SensingClass, rng: np.random.Generator, *, kind: str = "plain") -> Measurement:
    """Return a random measurement: any feature and position, SPD C and rank-two M over three decades.

    Args:
        kind: `plain`; `wide` for six decades; `flat` for no information about one direction error.
    """
    A, B = rotation(rng), rotation(rng)
    decades = 2.0 if kind == "wide" else 1.0
    C = A @ np.diag(np.exp(-2.3 - decades * rng.uniform(0.0, 6.9, 3))) @ A.T
    p = np.exp(decades * rng.uniform(0.0, 6.9, 2)) * [0.0 if kind == "flat" else 1.0, 1.0]
    M = B @ np.diag([0.0, *p]) @ B.T
    u = rng.normal(size=3)
    return Measurement(
        cls=cls, x_m=rng.normal(0, 0.3, 3), u=u / np.linalg.norm(u), mu_m=rng.normal(0, 0.3, 3),
        C_m2=C, M=M if cls >= 4 else np.zeros((3, 3)),
    )  # fmt: skip


def rotation(rng: np.random.Generator) -> Array:
    """Return a random (3, 3) rotation."""
    return np.asarray(Rotation.random(rng=rng).as_matrix())


def mismatched(answer: FusedPose) -> list[int]:
    """Return the indices of the measurements that were rejected."""
    return [r.index for r in answer.rejected if r.reason == "mismatch" and r.index >= 0]
