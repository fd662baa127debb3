"""Finds the panel with the camera: by its border lights, by printed tags, by its outline, or by its objects' looks.

A cell with lights uses them, and a dead lamp is reported, not worked around. Without lights the first way that finds the
panel is used, and the next one checks it in the same image.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fusion import PixelObservation, with_common_errors
from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import InvalidRequest, NotFound, PerceptionError
from hal.geometry import UncertainPose, compose, matrix_of
from perception.vision import (
    PanelPrior,
    PanelSighting,
    PanelWay,
    compare,
    find_by_looks,
    find_by_outline,
    find_by_tags,
    find_panel,
    find_panel_lights,
)
from service.operations.acquisition import FURTHER, LightPair, Look, in_better_light, look, look_with_lights, settle
from service.operations.session import Session
from service.operations.stored import knowledge_of
from service.schema.results import PanelCheck
from service.world_model import expected_panel


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Located:
    """The pose of the panel from one pose of the arm.

    Attributes:
        base_from_panel: the pose, with the covariance from image noise and camera mount.
        seen: what the panel was found by, and the points that gave the pose.
        look: the image, with the border lights off; `lit`: with lights on, None without lights.
        checks: what the other ways say.
        observations: rays to the points; `panel_observations` prepares them for fusion.
    """

    base_from_panel: UncertainPose
    seen: PanelSighting
    look: Look
    lit: Look | None
    checks: tuple[PanelCheck, ...]
    observations: tuple[PixelObservation, ...]

    @property
    def contradictions(self) -> list[str]:
        """The findings of the ways that contradict the one that was used."""
        return [check.finding for check in self.checks if check.contradicts]


def panel_observations(located: Sequence[Located]) -> tuple[PixelObservation, ...]:
    """Return the rays to the points by which the panel was found, from several poses of the arm together."""
    rays = [ray for found in located for ray in found.observations]
    return with_common_errors(rays, [built for found in located for built in found.seen.built_covariance_px])


def ways_of(session: Session) -> tuple[PanelWay, ...]:
    """Return the ways that can find the panel of this cell, in the order in which they are tried."""
    ways = [PanelWay.LIGHTS] if session.panel.lights and session.cell.names_of(DeviceKind.LIGHTS) else []
    ways += [PanelWay.TAGS] if session.panel.tags else []
    return (*ways, PanelWay.OUTLINE, PanelWay.LOOKS)


def locate(session: Session, by: PanelWay | None = None) -> Located:
    """Find the panel from the present pose of the arm and store its pose.

    Args:
        by: the only way to use; by default the first of `ways_of` that finds the panel, or the lights if there are any.

    Raises:
        NotFound, Ambiguous, PerceptionError: it is not found, or cannot be where it was found; gives each way's reason.
        InvalidRequest: the cell or the panel file lacks what `by` needs.
    """
    ways = ways_of(session)
    if by is not None and by not in ways:
        raise InvalidRequest(
            f"the panel cannot be found by its {by} in cell {session.cell.name!r}",
            hint=f"this cell can use: {', '.join(ways)}; lights need a device of kind lights, tags need [[tags]]",
        )
    found = _in_any_light(session, (by,) if by is not None else ways, further=FURTHER)
    session.world.believe_panel(found.base_from_panel)
    if found.contradictions:
        session.progress(1.0, "two ways of finding the panel disagree", "; ".join(found.contradictions))
    return found


def _in_any_light(session: Session, ways: tuple[PanelWay, ...], *, further: int) -> Located:
    """Find the panel by the first of the ways that does, and with other exposures in an image that is too dark or too bright.

    `further`: how many looks there may be after the first.
    """
    try:
        if ways[0] is not PanelWay.LIGHTS:
            session.progress(0.3, "look at the panel")
            settle(session)
            return in_look(session, look(session), ways)
        session.progress(0.3, "lights off, lights on")
        pair = look_with_lights(session)
        session.progress(0.8, "pose of the four lights")
        return by_lights(session, pair)
    except PerceptionError as lost:
        better = in_better_light(session, look(session)) if further > 0 else None
        if better is None:
            raise
        session.progress(0.3, "look with another exposure", lost.what)
        with better:
            return _in_any_light(session, ways, further=further - 1)


def by_lights(session: Session, pair: LightPair) -> Located:
    """Return the panel's pose from a pair of images with its lights off and on."""
    taken = pair.on
    found = find_panel(
        pair.off.pixels,
        pair.on.pixels,
        _lights_m(session),
        taken.intrinsics,
        prior=_prior(session, taken),
        lens_rms_px=session.lens_rms_px(taken.camera),
        light_sigma_m=session.panel.tolerances.light_m,
    )
    seen = PanelSighting(
        way=PanelWay.LIGHTS,
        camera_from_panel=found.camera_from_panel,
        names=tuple(light.name for light in session.panel.lights),
        points_m=_lights_m(session),
        points_px=found.lights.points_px,
        covariance_px=found.covariance_px,
        built_covariance_px=np.zeros((4, 2, 2)),
        chi_square=found.pose.chi_square,
        degrees_of_freedom=2,
        ambiguous=found.pose.ambiguous,
        alternatives=len(found.pose.alternatives),
    )
    others = (PanelWay.TAGS,) if session.panel.tags else ()
    return _located(seen, pair.off, pair.on, _checks(session, pair.off, seen, others))


def in_look(session: Session, taken: Look, ways: tuple[PanelWay, ...]) -> Located:
    """Return the panel's pose by the first of the ways that finds it in one image; the next one checks it.

    Raises:
        NotFound: none finds it; gives each one's reason and remedy.
    """
    failed: dict[PanelWay, PerceptionError] = {}
    for way in ways:
        try:
            seen = _find(session, taken, way)
        except PerceptionError as error:
            failed[way] = error
            continue
        left = ways_of(session)
        after = left[left.index(way) + 1 :][:1]
        checks = tuple(_refusal(tried, error) for tried, error in failed.items())
        return _located(seen, taken, None, (*checks, *_checks(session, taken, seen, after)))
    if len(failed) == 1:
        raise next(iter(failed.values()))
    raise NotFound(
        "the panel was not found: " + "; ".join(f"by its {way}: {error.what}" for way, error in failed.items()),
        hint="; ".join(dict.fromkeys(error.hint for error in failed.values())),
    )


def reference_points_m(session: Session) -> Array:
    """Return the points (N, 3) by which a camera is calibrated: the lights, or else the corners of all tags.

    Raises:
        InvalidRequest: the panel has neither; a plate's outline is not found in views that are turned or oblique.
    """
    way = ways_of(session)[0]
    if way is PanelWay.LIGHTS:
        return _lights_m(session)
    if way is PanelWay.TAGS:
        return np.array([corner for tag in session.panel.tags for corner in tag.corners_m])
    raise InvalidRequest(
        "a camera is calibrated by border lights or printed tags, and this panel has neither",
        hint="print tags, fix them to the plate and write them into the panel file ([[tags]])",
    )


def reference_in_view(session: Session) -> tuple[Array, Array]:
    """Look, and return the pixels (N, 2) of `reference_points_m` and their covariances (N, 2, 2) by image noise alone.

    Raises:
        NotFound, Ambiguous: not all of them are visible.
    """
    way = ways_of(session)[0]
    if way is PanelWay.LIGHTS:
        pair = look_with_lights(session)
        upright = pair.on.base_from_camera.parent_from_child.inv() * session.believed_panel().parent_from_child
        lights = find_panel_lights(
            pair.off.pixels, pair.on.pixels, _lights_m(session), pair.on.intrinsics, upright=matrix_of(upright)
        )
        return lights.points_px, lights.covariance_px
    settle(session)
    taken = look(session)
    seen, wanted = _find(session, taken, way), reference_points_m(session)
    order = [int(np.linalg.norm(seen.points_m - point, axis=1).argmin()) for point in wanted]
    if len(set(order)) < len(wanted) or not np.allclose(seen.points_m[order], wanted):
        raise NotFound(
            f"{len(seen.points_m)} of {len(wanted)} points of the panel's {way} are in view",
            hint="uncover them, or take away from the panel file what is not there",
        )
    noise = seen.covariance_px - session.lens_rms_px(taken.camera) ** 2 * np.eye(2)
    return seen.points_px[order], noise[order]


def _find(session: Session, taken: Look, way: PanelWay) -> PanelSighting:
    prior, lens_rms_px = _prior(session, taken), session.lens_rms_px(taken.camera)
    finders: dict[PanelWay, Callable[..., PanelSighting]] = {
        PanelWay.TAGS: find_by_tags,
        PanelWay.OUTLINE: find_by_outline,
    }
    if way is PanelWay.LOOKS:
        return find_by_looks(
            taken.pixels, session.panel, taken.intrinsics, knowledge_of(session), prior=prior, lens_rms_px=lens_rms_px
        )
    return finders[way](taken.pixels, session.panel, taken.intrinsics, prior=prior, lens_rms_px=lens_rms_px)


def _checks(session: Session, taken: Look, seen: PanelSighting, ways: tuple[PanelWay, ...]) -> tuple[PanelCheck, ...]:
    """Compare a sighting with other ways in the same image; a way that finds nothing says so."""
    checks = []
    for way in ways:
        try:
            other = _find(session, taken, way)
        except PerceptionError as error:
            checks.append(_refusal(way, error))
            continue
        compared = compare(seen, other)
        apart = f"{1e3 * compared.position_m:.1f} mm and {1e3 * compared.angle_rad:.1f} mrad"
        finding = f"{seen.way} and {way} agree within {apart}"
        if compared.contradicts:
            finding = (
                f"{seen.way} and {way} put the panel {apart} apart (chi-square {compared.chi_square:.0f} on 6 degrees of"
                " freedom): check what the panel file says about both, and measure it again"
            )
        checks.append(
            PanelCheck(
                way=way.value, position_m=compared.position_m, angle_rad=compared.angle_rad,
                chi_square=compared.chi_square, contradicts=compared.contradicts, finding=finding,
            )
        )  # fmt: skip
    return tuple(checks)


def _refusal(way: PanelWay, error: PerceptionError) -> PanelCheck:
    return PanelCheck(way=way.value, contradicts=False, finding=f"not found by its {way}: {error.what}")


def _located(seen: PanelSighting, taken: Look, lit: Look | None, checks: tuple[PanelCheck, ...]) -> Located:
    source = lit or taken
    rays = [
        PixelObservation(
            sensor=source.camera, base_from_flange=source.base_from_flange, name=name, point_m=point_m, pixel_px=pixel,
            covariance_px=covariance, intrinsics=source.intrinsics,
        )
        for name, point_m, pixel, covariance in zip(
            seen.names, seen.points_m, seen.points_px, seen.covariance_px, strict=True
        )
    ]  # fmt: skip
    return Located(
        base_from_panel=compose(source.base_from_camera, seen.camera_from_panel),
        seen=seen,
        look=taken,
        lit=lit,
        checks=checks,
        observations=tuple(rays),
    )


def _prior(session: Session, taken: Look) -> PanelPrior:
    workspace = session.cell.file.workspace
    camera_from_base = taken.base_from_camera.parent_from_child.inv()
    return PanelPrior(
        camera_from_panel=camera_from_base * session.believed_panel().parent_from_child,
        camera_from_expected=camera_from_base * expected_panel(session.cell).parent_from_child,
        position_tolerance_m=workspace.position_tolerance_m,
        angle_tolerance_rad=workspace.angle_tolerance_rad,
    )


def _lights_m(session: Session) -> Array:
    return np.array([light.position_m for light in session.panel.lights])
