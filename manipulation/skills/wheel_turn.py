"""One hold of a handwheel: turns the hand about the hub, and knows from the torque how far the wheel has followed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from hal.arrays import Array
from hal.motion import Compliance, Guard, MotionReport, Quantity
from hal.panel import Handwheel
from manipulation.planning.cartesian_path import arc, through, turned_about
from manipulation.skills.attempt import Attempt
from manipulation.skills.contact import relax
from manipulation.skills.outcome import Outcome, SkillFailure
from manipulation.skills.turning import Felt, felt_in

TURN_M_PER_S = 0.12
HEAVY_N, HEAVY_M_PER_S = 50.0, 0.03  # a larger side force is expected: the force overshoots less
LAG_RAD = 0.8  # largest turn by which the hand is ahead of the wheel, because the pads yield
FIRST_RAD = 0.3  # first part of a turn; it shows at which torque the wheel gives way
NEXT_RAD = 0.15
SHORTEST_RAD = np.radians(1.0)
MOVED_RAD = 0.1  # a wheel that stops before is stiff, one that stops later has stalled
LARGEST_SIDE_N = 82.0  # below the cell's protective limit
LARGEST_HELD_N = 60.0  # the same with the rim between the fingers, where friction is released in jumps
SIDE_TICKS = 4  # the hand's own vibration is not a load
STOP_RATIO, STOP_NM = 1.4, 0.35  # an end stop is a torque above this multiple of the felt one plus this much
SLIP_RATIO, SLIP_TICKS = 0.4, 10
LOG_SAMPLES = 300
SLIGHT_PER_NM = 1.0  # of a force along the line of the fingers; below it the spokes are opposite
SIDE_SAMPLES = 15  # of the log, an eighth of a second
INF = float("inf")
DAMPING = (4000.0, 4000.0, 4000.0, 10.0, 10.0, 10.0)
MASS = (400.0, 400.0, 400.0, 1.0, 1.0, 1.0)  # with 100 kg friction flips from tick to tick
MAX_OFFSET_M = 0.008
STEP_RAD = 0.03
FREEING_N, FREEING_M_PER_S = 40.0, 0.06
# Stiff enough to come back to the hub against the friction of fingers on spokes, soft enough for a rim that is met on the way.
FREEING = Compliance(
    stiffness=(1500.0, 1500.0, 400.0, INF, INF, INF), damping=(1500.0, 1500.0, 4000.0, 10.0, 10.0, 10.0),
    mass=(100.0, 100.0, 400.0, 1.0, 1.0, 1.0), max_offset_m=MAX_OFFSET_M,
)  # fmt: skip
BESIDE_M = 0.003  # distance from there at which friction holds the hand
PUSHING_FREE_N = 60.0
PUSHING_FREE = Compliance(
    stiffness=(8000.0, 8000.0, 400.0, INF, INF, INF), damping=(1500.0, 1500.0, 4000.0, 10.0, 10.0, 10.0),
    mass=(100.0, 100.0, 400.0, 1.0, 1.0, 1.0), max_offset_m=MAX_OFFSET_M,
)  # fmt: skip
LOADING_DAMPING, LOADING_MASS = (1500.0, 1500.0, 4000.0, 10.0, 10.0, 10.0), (150.0, 150.0, 400.0, 1.0, 1.0, 1.0)


@dataclass(slots=True, kw_only=True, eq=False)
class WheelTurn:
    """A hand on a wheel, either behind two spokes or with the rim between its fingers.

    Attributes:
        sign: 1 turns clockwise.
        behind_rad: turn of the hand before it meets the spokes; 0 with the rim between the fingers.
        most_nm: largest torque that this hold takes.
        up_m: how far the hand moves back to leave.
        open_m: opening that releases the rim; None when nothing is held between the fingers.
        speed_m_per_s: of the turn, where a turn of 1 rad counts as 0.1 m.
        is_across: whether the whole wheel is between the fingers, so that its hub is midway between them.
        side_per_nm: force along the line of the fingers for each N m, with which spokes that are not opposite push.
        free_rad: turn in which no end stop can be met; 0 where that is not known.
        ran_nm: torque at which the wheel turned in an earlier hold; 0 where it has not.
        moved_rad: how far the wheel has turned, not negative.
    """

    attempt: Attempt
    wheel: Handwheel
    sign: float
    behind_rad: float
    most_nm: float
    up_m: float
    open_m: float | None = None
    speed_m_per_s: float = TURN_M_PER_S
    side_per_nm: float = 0.0
    is_across: bool = False
    free_rad: float = 0.0
    ran_nm: float = 0.0
    moved_rad: float = 0.0
    _felt: Felt = field(default_factory=Felt)
    _side_n: float = 0.0
    _grip_from_hub: RigidTransform = field(init=False)
    _start: RigidTransform = field(init=False)

    def __post_init__(self) -> None:
        grip = self.attempt.pose()
        hub = grip.inv().apply(self.attempt.context.panel_pose.apply([*self.wheel.position_m, 0.0]))
        self._grip_from_hub = RigidTransform.from_translation([0.0 if self.is_across else hub[0], hub[1], 0.0])
        self._start = self._tool()

    @property
    def felt_nm(self) -> float:
        """Torque that moved the wheel, or the largest that did not."""
        return self._felt.running_nm if self._felt.is_moving else self._felt.peak_nm

    @property
    def hand_rad(self) -> float:
        """How far the hand has turned since it came down; the wheel cannot have turned further."""
        return max(0.0, self._felt.end_rad)

    def turn(self, span_rad: float) -> None:
        """Turn the wheel by `span_rad` (not negative).

        Raises:
            SkillFailure: `stiff`, `stalled` or `slipped`.
        """
        goal_rad = self.behind_rad + min(FIRST_RAD, span_rad)
        limit_rad = self.behind_rad + LAG_RAD + span_rad
        while True:
            report = self._turn_on(goal_rad)
            x_n, torque_nm = np.median(report.log.wrench[-SIDE_SAMPLES:][:, [0, 5]], axis=0)
            self._side_n = float(np.sign(x_n) * self.side_per_nm * max(0.0, -self.sign * torque_nm))
            felt = self._felt = felt_in(self._felt, *self._log(report), ran_nm=self.ran_nm)
            self.moved_rad = felt.moved_rad
            if report.tripped == "slip" or felt.has_slipped:
                raise SkillFailure(Outcome.SLIPPED, f"the fingers slipped at {felt.peak_nm:.1f} N m")
            if report.tripped is not None:
                outcome = Outcome.STIFF if felt.moved_rad < MOVED_RAD else Outcome.STALLED
                force_n = float(np.linalg.norm(report.wrench[:3]))
                raise SkillFailure(outcome, f"it did not give way at {felt.peak_nm:.1f} N m and {force_n:.0f} N")
            left_rad = span_rad - felt.moved_rad
            if left_rad < SHORTEST_RAD:
                return
            if felt.end_rad >= limit_rad - SHORTEST_RAD:
                raise SkillFailure(Outcome.SLIPPED, "the hand went all the way and the wheel did not follow")
            goal_rad = min(felt.end_rad + (left_rad if felt.is_moving else min(left_rad, NEXT_RAD)), limit_rad)

    def let_go(self) -> None:
        """Release the wheel, yield until nothing presses on the hand, bring the fingers clear of it, and move back."""
        if self.open_m is not None:
            self.attempt.open_to(self.open_m, name="let go")
        relax(self.attempt)
        if self.open_m is None and not self._felt.has_slipped:
            self._stand_free()
        self.attempt.leave(self.up_m)

    def _stand_free(self) -> None:
        """Turn the hand back to where its fingers stand to the spokes as when they came down, where the way out is free.

        A finger that is wedged between spoke, rim and hub presses on the wheel in opposite directions. The wrist feels
        none of it, an arm that gives way does not end it, and its friction holds the hand that moves back. A hand that
        friction keeps beside its place is pushed there once more, with more force.
        """
        goal = turned_about(self._start, self._start.translation, self._axis(), self.sign * self.moved_rad)
        self._bring_to(goal, FREEING, FREEING_N)
        if np.linalg.norm(self._tool().translation - goal.translation) > BESIDE_M:
            self._bring_to(goal, PUSHING_FREE, PUSHING_FREE_N)

    def _bring_to(self, goal: RigidTransform, compliance: Compliance, most_n: float) -> None:
        here = self._tool()
        back_rad = float((goal.rotation * here.rotation.inv()).as_rotvec() @ self._axis())
        count = 2 + int(abs(back_rad) / STEP_RAD)
        shares = np.linspace(0.0, 1.0, count)
        poses = [
            RigidTransform.from_components(
                here.translation + share * (goal.translation - here.translation),
                Rotation.from_rotvec(share * back_rad * self._axis()) * here.rotation,
            )
            for share in shares
        ]
        held = Guard(name="held", quantity=Quantity.FORCE, limit=most_n, ticks=SIDE_TICKS)
        motion = through(
            poses, name="stand free", speed_m_per_s=FREEING_M_PER_S, guards=(held,), compliance=compliance,
            flange_from_tool=self.attempt.context.flange_from_grip * self._grip_from_hub,
        )  # fmt: skip
        self.attempt.run(motion)

    def _axis(self) -> Array:
        clockwise: Array = self.attempt.context.panel_pose.rotation.apply([0.0, 0.0, -1.0])
        return clockwise

    def _tool(self) -> RigidTransform:
        """Return the measured pose of a tool whose origin is at the hub, for which the torque is that on the wheel."""
        return self.attempt.pose() * self._grip_from_hub

    def _turn_on(self, goal_rad: float) -> MotionReport:
        """Turn the hand on to `goal_rad`, counted from where it came down."""
        angle = self.sign * (goal_rad - self._felt.end_rad)
        here = self._tool()
        poses = arc(here, centre_m=here.translation, axis=self._axis(), angle_rad=angle)
        tool = self.attempt.context.flange_from_grip * self._grip_from_hub
        motion = through(
            poses, name="turn", speed_m_per_s=self.speed_m_per_s, flange_from_tool=tool, guards=self._guards(),
            compliance=self._yielding(),
        )  # fmt: skip
        return self.attempt.run(motion)

    def _yielding(self) -> Compliance:
        """Return how the hand yields: along the fingers, with the rim or the whole wheel between them also along their line.

        Across that line it does not yield then: of two pads on a wheel one slips first, and the push of the other moved a
        hand that yielded 6 mm off the hub.
        Behind spokes it yields across the line of the fingers until both push equally. Along that line it yields as soon as
        the wheel moves, or at once behind opposite spokes, down to the force with which these spokes push: what is more is
        friction on the spokes, along which fingers slide that do not turn about the true hub.
        """
        along = 400.0
        stiffness = (200.0, 200.0, along)
        if self.open_m is not None:
            stiffness = (200.0 if self.is_across else 50.0, INF, along)
        elif self.side_per_nm > SLIGHT_PER_NM and not self._felt.is_moving:
            stiffness = (INF, 200.0, along)
        is_loading = self.open_m is None and not self._felt.is_moving
        return Compliance(
            stiffness=(*stiffness, INF, INF, INF), max_offset_m=MAX_OFFSET_M,
            damping=LOADING_DAMPING if is_loading else DAMPING, mass=LOADING_MASS if is_loading else MASS,
            target_wrench=(self._side_n, 0.0, 0.0, 0.0, 0.0, 0.0),
        )  # fmt: skip

    def _guards(self) -> tuple[Guard, ...]:
        """Return what ends a turn: more torque than the felt one, the largest push, or a hold that gives way."""
        against = (0.0, 0.0, -self.sign)  # the tool's z points into the panel, so a clockwise turn is positive about it
        most_n = LARGEST_SIDE_N if self.open_m is None else LARGEST_HELD_N
        side = Guard(name="side force", quantity=Quantity.FORCE, limit=most_n, ticks=SIDE_TICKS)
        effort = Guard(name="effort", quantity=Quantity.TORQUE, limit=self.most_nm, axis=against)
        if (self.open_m is not None and not self.is_across) or not self._felt.is_moving:
            return effort, side
        is_free = (
            self._felt.moved_rad < self.free_rad
        )  # what resists there is the wheel, which was felt to be too light
        limit = self.most_nm if is_free else min(self.most_nm, STOP_RATIO * self._felt.running_nm + STOP_NM)
        slip_nm = SLIP_RATIO * self._felt.running_nm
        return (
            Guard(name="end stop", quantity=Quantity.TORQUE, limit=limit, axis=against),
            Guard(
                name="slip", quantity=Quantity.TORQUE, limit=slip_nm, axis=against, below=True, ticks=SLIP_TICKS
            ),
            side,
        )  # fmt: skip

    def _log(self, report: MotionReport) -> tuple[Array, Array]:
        """Return the turns of the hand (N,) since it came down, and the torques against them (N,)."""
        context, log = self.attempt.context, report.log
        rows = np.unique(np.linspace(0, len(log.times_s) - 1, LOG_SAMPLES).astype(int))
        tool = context.flange_from_grip * self._grip_from_hub
        poses = [context.kinematics.tool(q, tool) for q in log.positions_rad[rows]]
        turned = [
            self.sign * float((p.rotation * self._start.rotation.inv()).as_rotvec() @ self._axis()) for p in poses
        ]
        # A turn of more than half a revolution appears with the other sign; it continues from where the last one ended.
        near = self._felt.end_rad + np.unwrap(np.array(turned) - self._felt.end_rad)
        near += 2.0 * np.pi * np.round((self._felt.end_rad - near[0]) / (2.0 * np.pi))
        return near, -self.sign * log.wrench[rows, 5]
