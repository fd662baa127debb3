"""Collision-free transfers: the straight segment if it is free, else a search, shortcuts and timing."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.errors import Unreachable
from hal.motion import Guard, JointTrajectory
from manipulation.planning.collision import RECHECK_RAD, CollisionModel
from manipulation.planning.rrt import connect, shortcut
from manipulation.planning.smooth_path import SmoothPath
from manipulation.planning.time_parameterization import SpeedLimits, timed

SEARCH_STEP_RAD = 0.02  # checking step of the search; the result is checked again at RECHECK_RAD
DETOUR_RAD = 0.8  # how far a joint may leave the range between its two ends in the first search
END_SHARE = 0.9  # of the gap at an end; with all of it the end itself would violate the margin by rounding
REACHES = 0.5 ** np.arange(7)  # widths of a corner's rounding that are tried, in turn


@dataclass(frozen=True, slots=True, kw_only=True)
class Effort:
    """How long to search for a path: the largest number of searches, and of rounds in the last one."""

    searches: int
    rounds: int


THOROUGH = Effort(searches=6, rounds=8000)
QUICK = Effort(searches=2, rounds=400)  # far more than the searches of typical missions need (at most 24 nodes)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TransferPlanner:
    """Plans in joint space among the boxes of a collision model.

    Attributes:
        margin_m: least gap on the way.
        end_margin_m: least gap at both ends, where the tool may be near its object.
        seed: random seed; the same seed gives the same path.
    """

    model: CollisionModel
    flange_from_tool: RigidTransform
    limits: SpeedLimits
    margin_m: float = 0.008
    end_margin_m: float = 0.002
    seed: int = 0

    def plan(
        self,
        start_rad: Array,
        goal_rad: Array,
        *,
        name: str = "transfer",
        guards: tuple[Guard, ...] = (),
        effort: Effort = THOROUGH,
    ) -> JointTrajectory:
        """Plan a timed collision-free trajectory from rest at `start_rad` to rest at `goal_rad`, (n,) each.

        Raises:
            Unreachable: start or goal touches something, or no free path was found; names what is in the way.
        """
        margin = self._margin(start_rad, goal_rad)

        def free(a: Array, b: Array, step: float = SEARCH_STEP_RAD) -> float:
            return self.model.free_fraction(a, b, margin_m=margin, step_rad=step)

        if self.model.free_fraction(start_rad, goal_rad, margin_m=margin) == 1.0:
            return self._timed(SmoothPath.of(np.array([start_rad, goal_rad])), name, guards)
        for seed, path in enumerate(self._paths(start_rad, goal_rad, margin, effort), self.seed):
            rounded = self._rounded(shortcut(path, free=free, seed=seed), margin)
            if rounded is not None:
                return self._timed(rounded, name, guards)
        raise Unreachable(
            f"{name}: no collision-free path was found, in {effort.searches} searches of up to {effort.rounds} rounds",
            hint=f"the tightest place of the straight way is between {self._in_the_way(start_rad, goal_rad, margin)}",
        )

    def _paths(self, start: Array, goal: Array, margin: float, effort: Effort) -> Iterator[Array]:
        """Yield free paths (N, n), from search to search with twice as many rounds: a search that is lucky is short."""
        kin = self.model.kinematics
        lower, upper = self._search_range(start, goal)
        for search in range(effort.searches):
            path = connect(
                self.model, start, goal, margin_m=margin, check_rad=SEARCH_STEP_RAD, lower=lower, upper=upper,
                seed=self.seed + search, rounds=effort.rounds >> (effort.searches - 1 - search),
            )  # fmt: skip
            if path is not None:
                yield path
            lower, upper = kin.lower_rad, kin.upper_rad

    def _margin(self, start: Array, goal: Array) -> float:
        """Return the wanted margin, or a smaller one if the gaps at both ends require it."""
        gaps = [self.model.clearance_m(q, enough_m=self.margin_m) for q in (start, goal)]
        for which, q, gap in zip(("start", "goal"), (start, goal), gaps, strict=True):
            if gap < self.end_margin_m:
                raise Unreachable(
                    f"the {which} of the transfer leaves only {1e3 * gap:.1f} mm between {self.model.nearest(q)}",
                    hint="choose a standoff further out, or another turn of the tool",
                )
        return min(self.margin_m, *(END_SHARE * gap for gap in gaps))

    def _search_range(self, start: Array, goal: Array) -> tuple[Array, Array]:
        """Return joint limits a little beyond the two ends, because a whole turn of the wrist is never necessary."""
        kin = self.model.kinematics
        lower = np.maximum(kin.lower_rad, np.minimum(start, goal) - DETOUR_RAD)
        upper = np.minimum(kin.upper_rad, np.maximum(start, goal) + DETOUR_RAD)
        return lower, upper

    def _rounded(self, path: Array, margin: float) -> SmoothPath | None:
        """Round each corner as widely as its legs and the obstacles allow; None if one cannot be rounded.

        The legs are checked again, because the spacing of the search misses a thin obstacle such as a cable.
        """
        legs = itertools.pairwise(path)
        if any(self.model.free_fraction(a, b, margin_m=END_SHARE * margin) < 1.0 for a, b in legs):
            return None
        smooth = SmoothPath.of(path)
        for index in range(1, len(smooth.points_rad) - 1):
            most = float(smooth.reaches_rad[index])
            for reach in most * REACHES:
                smooth = smooth.with_reach(index, reach)
                if self.model.are_clear(smooth.corner(index, RECHECK_RAD), margin_m=0.5 * margin):
                    break
            else:
                return None
        return smooth

    def _timed(self, path: SmoothPath, name: str, guards: tuple[Guard, ...]) -> JointTrajectory:
        return timed(
            self.model.kinematics,
            path,
            flange_from_tool=self.flange_from_tool,
            limits=self.limits,
            name=name,
            guards=guards,
        )

    def _in_the_way(self, start: Array, goal: Array, margin: float) -> str:
        fraction = self.model.free_fraction(start, goal, margin_m=margin)
        beyond = min(1.0, fraction + 0.02)
        return self.model.nearest(start + beyond * (goal - start))
