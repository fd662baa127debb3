"""Collision checks of the arm against the panel, the floor and itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.geometry import matrix_of
from manipulation.arm.kinematics import Kinematics
from manipulation.planning import clearance
from manipulation.planning.shapes import Capsule, CollisionBox

RECHECK_RAD = 0.005  # a path must have no collision when it is checked every 5 mrad
SELF_SAMPLES = 400  # random joint vectors that show which pairs of links always touch


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollisionModel:
    """Arm and tool as capsules among boxes in the base frame.

    Attributes:
        tool: capsules on the flange (gripper, fingers, camera).
        boxes: obstacles in the base frame.
        ignored: (capsule, box) names that may touch; an empty capsule name means any.
        watched: (links + tool, boxes) which pairs are checked.
        self_pairs: (k, 2) capsule indices that must stay apart.
    """

    kinematics: Kinematics
    tool: tuple[Capsule, ...]
    boxes: tuple[CollisionBox, ...]
    watched: NDArray[np.bool_]
    self_pairs: NDArray[np.int64]
    tool_ends: Array
    radii: Array
    rotations: Array
    middles: Array
    halves: Array

    @classmethod
    def build(
        cls, kinematics: Kinematics, tool: Sequence[Capsule], boxes: Sequence[CollisionBox] = ()
    ) -> CollisionModel:
        """Build a model that watches all pairs but those that always touch (neighbouring links, foot and floor)."""
        radii = np.array([*kinematics.capabilities.link_radius_m, *(c.radius_m for c in tool)])
        ends = np.array([[c.start_m, c.end_m] for c in tool]).reshape(-1, 2, 3)
        bare = cls(
            kinematics=kinematics,
            tool=tuple(tool),
            boxes=(),
            watched=np.zeros((len(radii), 0), bool),
            self_pairs=np.empty((0, 2), np.int64),
            tool_ends=ends,
            radii=radii,
            rotations=np.zeros((0, 3, 3)),
            middles=np.zeros((0, 3)),
            halves=np.zeros((0, 3)),
        )
        return replace(bare, self_pairs=bare._separable_pairs()).with_boxes(boxes)

    def with_boxes(self, boxes: Iterable[CollisionBox], *, ignored: Iterable[tuple[str, str]] = ()) -> CollisionModel:
        """Return the same arm among other boxes; `ignored` pairs of (capsule or "", box) may touch."""
        boxes = tuple(boxes)
        names = self.capsule_names
        watched = np.ones((len(names), len(boxes)), bool)
        watched[0] = False  # the first link stands on the floor and does not move
        for capsule, touched in ignored:
            rows = [i for i, name in enumerate(names) if capsule in ("", name)]
            columns = [j for j, box in enumerate(boxes) if box.name == touched]
            watched[np.ix_(rows, columns)] = False
        for j, box in enumerate(boxes):
            if box.name == "floor":
                watched[1, j] = False  # the shoulder
        poses = [box.parent_from_box for box in boxes]
        return replace(
            self,
            boxes=boxes,
            watched=watched,
            rotations=np.array([matrix_of(p) for p in poses]).reshape(-1, 3, 3),
            middles=np.array([p.translation for p in poses]).reshape(-1, 3),
            halves=np.array([box.half_m for box in boxes]).reshape(-1, 3),
        )

    @property
    def capsule_names(self) -> tuple[str, ...]:
        """`link1` and so on, then the names of the tool's capsules."""
        links = tuple(f"link{i + 1}" for i in range(len(self.kinematics.dh)))
        return links + tuple(c.name for c in self.tool)

    def clearance_m(self, q_rad: Array, *, enough_m: float = np.inf) -> float:
        """Return the least gap over all watched pairs, m, negative when something overlaps; or any above `enough_m`."""
        return self._least_m(q_rad, -np.inf, enough_m)

    def is_clear(self, q_rad: Array, *, margin_m: float) -> bool:
        """Return whether every watched gap is at least the margin."""
        return self._least_m(q_rad, margin_m, margin_m) >= margin_m

    def _least_m(self, q_rad: Array, stop_below_m: float, enough_m: float) -> float:
        return float(
            clearance.least_clearance(
                self.kinematics.dh, q_rad, self.tool_ends, self.radii, self.rotations, self.middles, self.halves,
                self.watched, self.self_pairs, stop_below_m, enough_m,
            )
        )  # fmt: skip

    def are_clear(self, samples_rad: Array, *, margin_m: float) -> bool:
        """Return whether every watched gap is at least the margin at all of the joint vectors (m, n)."""
        return bool(
            clearance.all_clear(
                self.kinematics.dh, np.ascontiguousarray(samples_rad), self.tool_ends, self.radii, self.rotations,
                self.middles, self.halves, self.watched, self.self_pairs, margin_m,
            )
        )  # fmt: skip

    def free_fraction(
        self, start_rad: Array, end_rad: Array, *, margin_m: float, step_rad: float = RECHECK_RAD
    ) -> float:
        """Return the fraction of the straight joint segment that is free, from its start: 1 when all of it is."""
        return float(
            clearance.first_hit(
                self.kinematics.dh, start_rad, end_rad, step_rad, self.tool_ends, self.radii, self.rotations,
                self.middles, self.halves, self.watched, self.self_pairs, margin_m,
            )
        )  # fmt: skip

    def nearest(self, q_rad: Array) -> str:
        """Return the names of the two things that are nearest to each other at `q_rad`, for error messages."""
        ends = clearance.capsule_ends(self.kinematics.dh, q_rad, self.tool_ends)
        names = self.capsule_names
        gaps = [
            (
                clearance.segment_box(ends[i, 0], ends[i, 1], self.rotations[j], self.middles[j], self.halves[j])
                - self.radii[i],
                f"{names[i]} and {box.name}",
            )
            for i in range(len(names))
            for j, box in enumerate(self.boxes)
            if self.watched[i, j]
        ]
        for i, j in self.self_pairs:
            apart = clearance.segment_segment(ends[i, 0], ends[i, 1], ends[j, 0], ends[j, 1])
            gaps.append((apart - self.radii[i] - self.radii[j], f"{names[i]} and {names[j]}"))
        return min(gaps)[1] if gaps else "nothing"

    def distances_m(self, q_rad: Array, points_m: Array) -> Array:
        """Return how far points (N, 3) of the base frame are from the surface of arm and tool, m, negative inside: (N,)."""
        starts, ends = np.moveaxis(clearance.capsule_ends(self.kinematics.dh, q_rad, self.tool_ends), 1, 0)
        least = np.full(len(points_m), np.inf)
        for start, along, radius in zip(starts, ends - starts, self.radii, strict=True):
            share = np.clip((points_m - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
            apart = np.linalg.norm(points_m - start - share[:, None] * along, axis=1)
            least = np.minimum(least, apart - radius)
        return least

    def _separable_pairs(self) -> NDArray[np.int64]:
        """Return the pairs of capsules, not neighbours, that are apart in at least half of all configurations."""
        kin = self.kinematics
        rng = np.random.default_rng(0)  # the result depends on the geometry; the seed only fixes the samples
        count, links = len(self.radii), len(kin.dh)
        pairs = np.array(
            [(i, j) for i in range(count) for j in range(i + 2, count) if i < links - 1], np.int64
        ).reshape(-1, 2)
        samples = rng.uniform(kin.lower_rad, kin.upper_rad, (SELF_SAMPLES, links))
        hits = clearance.overlap_counts(kin.dh, samples, self.tool_ends, self.radii, pairs)
        return np.asarray(pairs[hits < 0.5 * SELF_SAMPLES])


def placed(boxes: Iterable[CollisionBox], base_from_panel: RigidTransform) -> tuple[CollisionBox, ...]:
    """Return boxes of the panel frame in the base frame."""
    return tuple(box.moved(base_from_panel) for box in boxes)
