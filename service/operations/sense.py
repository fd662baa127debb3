"""The verb `fuse`: measures the panel with all sensors and fuses the measurements into one pose.

The fingers hover over the plate and touch it, each time at the place with the highest expected gain per second, until
the pose is as accurate as wanted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import (
    FusedObservations,
    Observation,
    PoseTolerance,
    ProximityObservation,
    SensingChoice,
    TouchObservation,
    TouchPlan,
    error_budget,
    fuse,
    fuse_observations,
)
from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import MotionError, NotFound, Stopped
from hal.geometry import UncertainPose
from manipulation import SkillFailure, plausibility, proximity_probe, touch_points, touch_probe
from service.operations.acquisition import settle
from service.operations.find_panel import locate, panel_observations
from service.operations.inspect import ensure_located
from service.operations.locate import ensure_space_is_known, go_to_overview, scan_plate
from service.operations.session import Session
from service.operations.travel import skill_context
from service.schema.fuse_request import FuseRequest
from service.schema.fuse_results import FuseResult, TouchingResult, TouchResult, answer_of

HOVER_M = 0.05  # height of the fingertips above the plate while the proximity sensors are read
HOVER_SAMPLES = 5
LEAST_TOUCHES = 3
REST_S = 0.02  # the time of two readings of a proximity sensor
SPARE_SPOTS = 2  # additional places, which replace those that the arm cannot reach
TOUCH_SIGMA_M = 0.0003  # as stated by `touch_probe`


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Felt:
    """The result of touching: the observations, and the gain of each touch."""

    observations: tuple[Observation, ...]
    account: TouchingResult


def fuse_and_remember(session: Session, observations: Sequence[Observation]) -> FusedObservations:
    """Fuse all observations into one pose and store it as the cell's estimate."""
    fused = fuse_observations(
        observations,
        mounts_of(session, observations),
        lenses=session.one_sigma_lenses(),
        prior=session.believed_panel(),
    )
    session.world.believe_panel(fused.base_from_panel)
    return fused


def fused_result(answer: FusedObservations, felt: Felt) -> FuseResult:
    """Return the fused pose in the form of reports and the API."""
    result = answer_of(answer.base_from_panel, answer.fused, answer.measurements)
    return result.model_copy(update={"touching": felt.account})


def run_fuse(session: Session, request: FuseRequest) -> FuseResult:
    """Run the verb `fuse` with the given measurements, or with measurements that the cell collects."""
    if request.collect:
        observations, felt = collect(session, request)
        return fused_result(fuse_and_remember(session, observations), felt)
    measurements = [body.measurement() for body in request.measurements]
    fused = fuse(
        measurements,
        prior=request.prior.pose() if request.prior is not None else None,
        shape=request.shape.shape() if request.shape is not None else None,
        certify=request.certify,
        prove_set_within_s=request.prove_set_within_s,
    )
    return answer_of(fused.base_from_object, fused, measurements)


def collect(session: Session, request: FuseRequest) -> tuple[tuple[Observation, ...], Felt]:
    """Take images, scan, hover and touch; returns all observations, and the result of touching."""
    ensure_located(session.part(0.0, 0.2))
    go_to_overview(session)
    known: tuple[Observation, ...] = panel_observations([locate(session.part(0.2, 0.3))])
    if session.cell.names_of(DeviceKind.RANGE_SCANNER):
        session.progress(0.3, "scan the plate")
        known = (*known, scan_plate(session).observation)
    felt = feel(session.part(0.35, 1.0), request.touches, known, request.wanted.tolerance())
    return (*known, *felt.observations), felt


def feel(session: Session, touches: int, known: Sequence[Observation], tolerance: PoseTolerance) -> Felt:
    """Hover over and touch free places of the plate, each time the one with the highest expected gain per second.

    It ends when the pose is accurate enough, when no further place is worth the time, or after `touches` places.

    Args:
        touches: the largest number of touches.
        known: the observations made so far.
        tolerance: the wanted accuracy of the pose.

    Raises:
        NotFound: fewer than three places could be touched, and the pose is not accurate enough; gives the reasons.
        Stopped: somebody stopped the cell.
    """
    ensure_space_is_known(session)
    return touch_by_plan(session, touch_plan(session, touches, known, tolerance), touches)


def touch_by_plan(session: Session, plan: TouchPlan, touches: int) -> Felt:
    """Touch the places of the plan in order of their gain; see `feel`."""
    observations: list[Observation] = []
    accounts: list[TouchResult] = []
    skipped: list[str] = []
    monitor = plausibility.ProximityMonitor(session.panel)
    ended = "the requested number of places was touched"
    while len(accounts) < touches:
        choice = plan.choice()
        if reason := plan.reason_to_stop(choice):
            ended = reason
            break
        assert choice is not None  # noqa: S101 - there is a reason to stop otherwise
        spot = plan.spots_m[choice.index]
        expected = 100.0 * (1.0 - choice.error_after / choice.error_before)
        session.progress(
            len(accounts) / touches,
            "touch the plate",
            f"at ({spot[0]:.3f}, {spot[1]:.3f}) m, expected to lower the pose's mean square error by {expected:.1f} %",
        )
        try:
            found = _feel_at(session, spot, monitor)
        except Stopped:
            raise  # another place would not help
        except (SkillFailure, MotionError) as failure:
            skipped.append(f"({spot[0]:.3f}, {spot[1]:.3f}) m: {failure}")
            plan = plan.without(choice.index)
            continue
        observations += found
        told = error_budget(found, mounts_of(session, found), plan.base_from_panel)
        plan = plan.after(choice.index, told)
        accounts.append(_worth(spot, choice, plan.error))
    if len(accounts) < LEAST_TOUCHES and skipped and not plan.offers:
        raise NotFound(
            f"only {len(accounts)} of {touches} places of the plate could be touched: {'; '.join(skipped)}",
            hint="check that the panel has not moved since it was located, and that nothing is in the way",
        )
    account = TouchingResult(touches=accounts, skipped=skipped, ended=ended)
    return Felt(observations=tuple(observations), account=account)


def _worth(spot: Array, choice: SensingChoice, error_after: float) -> TouchResult:
    expected, brought = (100.0 * (1.0 - error / choice.error_before) for error in (choice.error_after, error_after))
    return TouchResult(
        spot_m=[float(along) for along in spot],
        error_before=choice.error_before,
        error_expected=choice.error_after,
        error_after=error_after,
        words=f"({spot[0]:.3f}, {spot[1]:.3f}) m: expected to lower the pose's mean square error by {expected:.1f} %, "
        f"lowered it by {brought:.1f} %",
    )


def mounts_of(session: Session, observations: Sequence[Observation]) -> dict[str, UncertainPose]:
    """`flange_from_sensor` of every sensor that gave observations."""
    return {sensor: session.mount(sensor) for sensor in sorted({o.sensor for o in observations})}


def touch_plan(session: Session, touches: int, known: Sequence[Observation], tolerance: PoseTolerance) -> TouchPlan:
    """Return a plan with free places of the plate and the expected information of a touch at each of them."""
    base_from_panel = session.known_panel().parent_from_child
    spots_m = touch_points(session.panel, touches + SPARE_SPOTS)
    expected = [_expected_at(session, base_from_panel, spot) for spot in spots_m]
    return TouchPlan(
        base_from_panel=base_from_panel,
        budget=error_budget(known, mounts_of(session, known), base_from_panel, lenses=session.one_sigma_lenses()),
        tolerance=tolerance,
        spots_m=spots_m,
        offers=tuple(error_budget(each, mounts_of(session, each), base_from_panel) for each in expected),
        places=touches,
        tip_m=_fingers_over_panel(session),
        speed_m_per_s=session.cell.file.safety.speed_limit_m_per_s,
    )


def _expected_at(session: Session, base_from_panel: RigidTransform, spot: Array) -> list[Observation]:
    """Return the observations expected from hovering over a place and touching it, at the estimated panel pose."""
    gripper = session.first(DeviceKind.GRIPPER)
    flange_from_grip = session.mount(gripper).parent_from_child
    facing = Rotation.from_rotvec([np.pi, 0.0, 0.0])  # the fingers point into the plate

    def base_from_flange(height_m: float) -> RigidTransform:
        panel_from_grip = RigidTransform.from_components([float(spot[0]), float(spot[1]), height_m], facing)
        return base_from_panel * panel_from_grip * flange_from_grip.inv()

    touched = TouchObservation(
        sensor=gripper, base_from_flange=base_from_flange(0.0), tip_m=np.zeros(3), sigma_m=TOUCH_SIGMA_M, label="touch"
    )
    expected: list[Observation] = [touched]
    for name in _proximity_sensors(session):
        hovering = base_from_panel.inv() * base_from_flange(HOVER_M) * session.mount(name).parent_from_child
        sigma_m = session.connection.device(name).capabilities().sigma_m
        expected.append(
            ProximityObservation(
                sensor=name,
                base_from_flange=base_from_flange(HOVER_M),
                distance_m=float(-hovering.translation[2] / hovering.rotation.as_matrix()[2, 2]),
                sigma_m=sigma_m * HOVER_SAMPLES**-0.5,
                label=name,
            )
        )
    return expected


def _proximity_sensors(session: Session) -> list[str]:
    return [name for name in session.cell.names_of(DeviceKind.PROXIMITY) if session.has_mount(name)]


def _fingers_over_panel(session: Session) -> Array:
    """Return the panel point (2,) under the finger tips."""
    context = skill_context(session)
    tip = context.mover.state().base_from_flange * context.flange_from_grip
    return np.asarray(context.panel_pose.inv().apply(tip.translation)[:2])


def _feel_at(session: Session, spot: Array, monitor: plausibility.ProximityMonitor) -> list[Observation]:
    context = skill_context(session)
    place = (float(spot[0]), float(spot[1]), 0.0)
    observations: list[Observation] = []
    proximities = session.cell.names_of(DeviceKind.PROXIMITY)
    names = _proximity_sensors(session)
    of = {name: session.connection.device(name).capabilities() for name in names}
    mounts = [session.mount(name).parent_from_child for name in names]
    hovered = context.mover.state()
    if names:
        sigma_m = max(each.sigma_m for each in of.values())
        points = proximity_probe(
            context, place, flange_from_sensors=mounts, distance_m=HOVER_M, samples=HOVER_SAMPLES, sigma_m=sigma_m
        )
        hovered = context.mover.state()
        flange = hovered.base_from_flange
        for point in points:
            name = _whose(names, mounts, flange, point.base_from_sensor)
            observations.append(
                ProximityObservation(
                    sensor=name,
                    base_from_flange=flange,
                    distance_m=point.distance_m,
                    sigma_m=point.sigma_m,
                    label=f"{name} at ({spot[0]:.3f}, {spot[1]:.3f})",
                )
            )
    touched = touch_probe(context, place)
    settle(session, REST_S)
    for name, mount in zip(names, mounts, strict=True):
        k = proximities.index(name)
        finding = monitor.note(
            name,
            of[name],
            [(state.base_from_flange * mount, state.proximity_m[k]) for state in (hovered, context.mover.state())],
            base_from_panel=context.panel_pose,
            touched_m=touched.point_m,
        )
        if finding is not None:
            raise finding.error()
    base_from_grip = touched.report.base_from_tool
    touch = TouchObservation(
        sensor=session.first(DeviceKind.GRIPPER),
        base_from_flange=base_from_grip * context.flange_from_grip.inv(),
        tip_m=base_from_grip.inv().apply(touched.point_m),
        sigma_m=float(np.sqrt(touched.normal @ touched.covariance @ touched.normal)),
        label=f"touch at ({spot[0]:.3f}, {spot[1]:.3f})",
    )
    return [*observations, touch]


def _whose(names: Sequence[str], mounts: Sequence[Any], flange: Any, base_from_sensor: Any) -> str:
    """Return the name of the sensor at a pose, because the probe leaves out sensors that measured nothing."""
    gaps = [np.linalg.norm((flange * mount).translation - base_from_sensor.translation) for mount in mounts]
    return names[int(np.argmin(gaps))]


def pose_error(session: Session, known: Sequence[Observation], tolerance: PoseTolerance) -> float:
    """Return the mean square error of the pose that the observations give, in units of the tolerance."""
    base_from_panel = session.known_panel().parent_from_child
    budget = error_budget(known, mounts_of(session, known), base_from_panel, lenses=session.one_sigma_lenses())
    return tolerance.error_of(budget.covariance, base_from_panel)
