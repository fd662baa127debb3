"""Finds objects of the panel file by their surfaces in a range image and compares them with panel file and vision.

This covers the kinds with a relief, such as mushroom buttons and handwheels. An object that is not found, or is found
in another place, is scanned again from a shorter distance. The panel file is not corrected: an object that is still
found in another place is reported and not operated. Caps whose states look alike are read by their heights, and objects
behind a cable are looked at from the side that shows most of them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.devices import DeviceKind
from hal.errors import DeviceError, NotFound, PerceptionError, Unreachable, Unsupported
from hal.geometry import UncertainPose
from hal.panel import Cap, Panel, PanelObject
from perception.range import (
    PanelScan,
    RangeScene,
    Sighting,
    Surface,
    analyse,
    check_place,
    find_objects,
    measure_cap,
    outline_px,
    states_agree,
)
from perception.vision import ObjectReading, viewpoints
from service.operations.acquisition import Scan, has_range_camera, scan, settle
from service.operations.locate import ScannedPlane, ensure_space_is_known, obstacles_in, plate_in, scan_plate
from service.operations.session import Session
from service.operations.travel import go_to_first
from service.report.plots import png_of
from service.report.record import Picture
from service.report.surfaces import Mark, surfaces_picture
from service.schema.mission_results import SurfaceCheck

OVERVIEW, FACING, CLOSER = "the overview", "before the panel", "a closer look"
FOOTPRINT_POINTS = 9  # along each side of a footprint, of which a cable may hide some
HIDDEN = 0.3  # share of a footprint behind something, from which a reading is looked at from a side as well
FOOTPRINT_RATIO = 1.4  # of an object with the plate around it to its footprint
SURE_ODDS = 6.0  # least logarithm of the odds of a state that a height proves


def surfaces_in(image: Scan) -> RangeScene:
    """Segment a range image into surfaces.

    Raises:
        Unsupported: the image is not a pinhole projection.
        InvalidRequest, NotFound: see `analyse`.
    """
    return analyse(image.depth_m, image.pinhole())


def find_by_surfaces(
    scene: RangeScene, image: Scan, panel: Panel, base_from_panel: UncertainPose, plate: Surface
) -> list[Sighting]:
    """Find the panel's objects with a relief in a scan; see `find_objects`."""
    depth_m = np.asarray(image.depth_m, float)
    view = PanelScan(
        scene=scene,
        depth_m=depth_m,
        base_from_sensor=image.base_from_scanner,
        plate=plate,
        base_from_panel=base_from_panel,
    )
    return find_objects(panel, view)


def mark_of(sighting: Sighting, image: Scan, base_from_panel: UncertainPose) -> Mark:
    """Return the object's outline at its height, where it was found or else where it was looked for."""
    name = sighting.panel_object.name
    return Mark(
        outline_px=outline_px(
            sighting, image.pinhole(), image.base_from_scanner.parent_from_child, base_from_panel.parent_from_child
        ),
        text=name if sighting.match is not None else f"{name}: {sighting.why}",
        is_found=sighting.match is not None,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SurfaceView:
    """One scan with its surfaces and the objects found in it; `place` describes the pose of the arm."""

    place: str
    scan: Scan
    scene: RangeScene
    sightings: tuple[Sighting, ...]


def view_surfaces(session: Session, plane: ScannedPlane, place: str) -> SurfaceView:
    """Find the objects with a relief in a scan whose plate is known."""
    scene = surfaces_in(plane.scan)
    found = find_by_surfaces(scene, plane.scan, session.panel, session.believed_panel(), plane.fit.surface)
    return SurfaceView(place=place, scan=plane.scan, scene=scene, sightings=tuple(found))


def check_surfaces(
    session: Session, first: SurfaceView, near: Sequence[Scan] = ()
) -> tuple[list[SurfaceCheck], list[Picture]]:
    """Compare the objects of a scan of the whole panel, and those that disagree or were not found in a nearer one.

    Args:
        near: range images that were taken before; the scanner is driven to an object that none of them shows.

    Raises:
        NotFound: the panel has not been located.
        Stopped, DeviceFault, MotionError, Cancelled: the cell cannot go on.
    """
    base_from_panel, shown = session.known_panel(), session.world.readings
    checks: list[SurfaceCheck] = []
    pictures = [_picture(session, first, "surfaces")]
    for sighting in first.sightings:
        name = sighting.panel_object.name
        check = compared(sighting, base_from_panel, session.panel.tolerances.position_m, shown.get(name), first.place)
        if not check.agrees:
            again = _nearer_view(session, near, sighting.panel_object) or _look_closer(session, sighting.panel_object)
            if isinstance(again, SurfaceView):
                pictures.append(_picture(session, again, f"surfaces-{name}"))
                (second,) = [s for s in again.sightings if s.panel_object.name == name]
                closer = compared(second, base_from_panel, session.panel.tolerances.position_m, shown.get(name), CLOSER)
                check = after_both(check, closer)
            else:
                check = check.model_copy(update={"finding": f"{check.finding}; no closer look: {again}"})
        checks.append(check)
    return checks, pictures


def compared(
    sighting: Sighting, base_from_panel: UncertainPose, position_m: float, reading: ObjectReading | None, place: str
) -> SurfaceCheck:
    """Compare a sighting with the panel file and with vision.

    Args:
        position_m: one sigma of the distance between an object of a built panel and its place in the file.
    """
    panel_object, found = sighting.panel_object, sighting.base_from_object
    vision_shows = _said(panel_object, reading)
    place_check = check_place(sighting, base_from_panel, position_m)
    if found is None or place_check is None:
        return SurfaceCheck(
            name=panel_object.name, kind=panel_object.kind, seen_from=place, found=False, agrees=None, centre_in_base_m=None,
            off_m=None, sigma_m=None, chi_square=None, off_vision_m=None, shows=None, vision_shows=vision_shows,
            stands_elsewhere=False,
            finding=f"not found by its surfaces: {sighting.why}",
        )  # fmt: skip
    x, y, z = found.parent_from_child.translation
    is_alike = _shows_alike(sighting, reading)
    off_m, sigma_m = place_check.off_m, place_check.sigma_m
    seen = None if reading is None or reading.centre_m is None else reading.centre_m[:2]
    finding = f"stands {1e3 * off_m:.1f} mm from its place in the panel file (1 sigma {1e3 * sigma_m:.1f} mm)"
    if not is_alike:
        finding += f"; shows {_shown(sighting)} by its surfaces and {vision_shows} by vision"
    return SurfaceCheck(
        name=panel_object.name, kind=panel_object.kind, seen_from=place, found=True,
        agrees=is_alike and not place_check.is_elsewhere,
        centre_in_base_m=(float(x), float(y), float(z)), off_m=off_m, sigma_m=sigma_m, chi_square=place_check.chi_square,
        off_vision_m=None if seen is None else float(np.linalg.norm(place_check.at_m - seen)),
        shows=_shown(sighting), vision_shows=vision_shows, stands_elsewhere=place_check.is_elsewhere, finding=finding,
    )  # fmt: skip


def after_both(first: SurfaceCheck, second: SurfaceCheck) -> SurfaceCheck:
    """Combine two scans of an object: the second one counts if it found the object; the text mentions both."""
    newest = second if second.found else first
    both = f"from {first.seen_from} {first.finding}; from {second.seen_from} {second.finding}"
    return newest.model_copy(update={"finding": both})


def need_its_place(checks: Iterable[SurfaceCheck], name: str) -> None:
    """Refuse to operate an object that is not in its place, because the fingers would go to its place in the file.

    Raises:
        NotFound: the object was found in another place, in both scans if there were two.
    """
    for check in checks:
        if check.name == name and check.stands_elsewhere:
            raise NotFound(
                f"{name} is not operated: {check.finding}",
                hint="correct its position_m in the panel file, or measure the scanner's mount (`panelwright calibrate scanner`)",
            )


def _shown(sighting: Sighting) -> str | None:
    """Return the state by surfaces in the terms of vision; a wheel's angle is known modulo one spoke."""
    relief, state = sighting.panel_object.relief, sighting.state
    if state is None or relief is None:
        return None
    if relief.motion == "slide":
        return relief.state_name(state)
    return f"{np.degrees(state):.0f} deg (modulo {360 / relief.turns:.0f})"


def _said(panel_object: PanelObject, reading: ObjectReading | None) -> str | None:
    if reading is None or not reading.answered:
        return None
    if not panel_object.value_is_angle or reading.value is None:
        return reading.state
    return f"{np.degrees(reading.value):.0f} deg"


def _shows_alike(sighting: Sighting, reading: ObjectReading | None) -> bool:
    """Return whether surfaces and vision give the same state, or at least one of them gives none."""
    if reading is None or not reading.answered:
        return True
    return states_agree(sighting, state=reading.state, value=reading.value, sigma=reading.uncertainty)


def _nearer_view(session: Session, near: Iterable[Scan], panel_object: PanelObject) -> SurfaceView | None:
    """Return the surfaces of the first range image that shows all of the object; None if none does."""
    for image in near:
        if _shows_all(image, session.known_panel().parent_from_child, panel_object):
            with suppress(NotFound):
                return view_surfaces(session, plate_in(session, image), CLOSER)
    return None


def _shows_all(image: Scan, base_from_panel: RigidTransform, panel_object: PanelObject) -> bool:
    """Return whether the footprint of the object, and the plate around it, lies within the image."""
    x, y, z = panel_object.point_m
    half_x, half_y = FOOTPRINT_RATIO * np.array(panel_object.half_footprint_m)
    corners = [(x + a, y + b, z) for a in (-half_x, half_x) for b in (-half_y, half_y)]
    c, scanner_from_base = image.capabilities, image.base_from_scanner.parent_from_child.inv()
    in_scanner = scanner_from_base.apply(base_from_panel.apply(corners))
    if in_scanner[:, 2].min() < c.min_range_m:
        return False
    u, v = np.array([c.cx, c.cy])[:, None] + np.array([c.fx, c.fy])[:, None] * (in_scanner[:, :2] / in_scanner[:, 2:]).T
    return bool(min(u.min(), v.min()) >= 0.0 and u.max() <= c.width - 1.0 and v.max() <= c.height - 1.0)


def _look_closer(session: Session, panel_object: PanelObject) -> SurfaceView | str:
    """Scan the object from a pose perpendicular to it; returns the reason as text when that is not possible."""
    try:
        _face(session, panel_object.point_m, name=f"closer look at {panel_object.name}")
        return view_surfaces(session, scan_plate(session), CLOSER)
    except (PerceptionError, Unreachable) as error:
        return error.what


def _face(session: Session, point_m: tuple[float, float, float], *, name: str) -> None:
    """Drive the scanner to a close-up of a panel point.

    Raises:
        Unreachable: the arm reaches no such pose.
    """
    flange_from_scanner = session.mount(session.first(DeviceKind.RANGE_SCANNER)).parent_from_child
    views = viewpoints.close_up_poses(session.known_panel().parent_from_child, point_m)
    go_to_first(session, (view * flange_from_scanner.inv() for view in views), name=name[:60])
    settle(session)


def _picture(session: Session, view: SurfaceView, name: str) -> Picture:
    marks = [mark_of(s, view.scan, session.believed_panel()) for s in view.sightings]
    title = f"surfaces in the range image from {view.place}, and the objects of the panel file in it"
    return Picture(name=name, title=title, png=png_of(surfaces_picture(view.scene, marks)))


def scan_beside(session: Session) -> tuple[Scan, ...]:
    """Return a range image from the pose of a camera's look; empty without a range camera, or when it fails.

    It shows a part of the panel beside that in the look, from near, so that fewer ways to such views are needed.
    """
    if not has_range_camera(session):
        return ()
    try:
        return (scan(session),)
    except DeviceError as error:
        session.progress(1.0, "look", f"no range image: {error.what}")
        return ()


def read_by_height(
    session: Session, readings: Sequence[ObjectReading], near: Iterable[Scan] = ()
) -> dict[str, ObjectReading]:
    """Return new readings of those caps whose height in a range image proves their state.

    A line scanner is not swept for it, because looks from the sides take less time. The same holds for a scanner that
    fails: the failure is told as progress, and the caps are looked at from the sides.

    Args:
        near: range images that were taken before; the scanner is driven to caps whose height none of them proves.
    """
    unread = {reading.name: reading for reading in readings if session.panel.object(reading.name).cap is not None}
    if not unread or not has_range_camera(session):
        return {}
    proved: dict[str, ObjectReading] = {}

    def left() -> list[PanelObject]:
        return [session.panel.object(name) for name in unread if name not in proved]

    try:
        for image, caps in itertools.chain(((image, left()) for image in near), _scans(session, left)):
            for cap in caps:
                odds = _released_log_odds(session, image, cap)
                if odds is not None and abs(odds) >= SURE_ODDS:
                    proved[cap.name] = _reading(unread[cap.name], odds)
    except (DeviceError, PerceptionError, Unreachable) as error:
        session.progress(1.0, "look past what hides it", f"no range image of {', '.join(unread)}: {error.what}")
    return proved


def _scans(session: Session, left: Callable[[], list[PanelObject]]) -> Iterator[tuple[Scan, Sequence[PanelObject]]]:
    """Yield range images from close-ups that together show all caps that are left at the first, and the caps in each."""
    for (x, y, z), names in viewpoints.close_up_groups(left(), session.lens()):
        title = f"heights of {', '.join(names)}"
        session.progress(1.0, "look past what hides it", title)
        _face(session, (x, y, z), name=title)
        yield scan(session), [session.panel.object(name) for name in names]


def _released_log_odds(session: Session, image: Scan, panel_object: PanelObject) -> float | None:
    """Return the log odds of `released`; None if the image does not show the cap."""
    cap: Cap | None = panel_object.cap
    if cap is None:
        return None
    panel_from_foot = RigidTransform.from_translation(np.array(panel_object.point_m))
    base_from_foot = session.known_panel().parent_from_child * panel_from_foot
    measured = measure_cap(
        np.asarray(image.depth_m, float),
        image.pinhole(),
        cap,
        foot_from_sensor=base_from_foot.inv() * image.base_from_scanner.parent_from_child,
        sensor_sigma_m=image.capabilities.sigma_m,
    )
    return None if measured is None else cap.released_log_odds(measured.height_m, measured.sigma_m)


def _reading(unread: ObjectReading, odds: float) -> ObjectReading:
    confidence = float(1.0 / (1.0 + np.exp(-abs(odds))))
    state = "released" if odds > 0 else "pressed"
    return replace(unread, state=state, confidence=confidence, reason=None, guess=None)


def sides_by_sight(session: Session, group: Collection[str], scans: Iterable[Scan]) -> list[str]:
    """Return the sides from which what stands before the panel hides the least of some objects first.

    What stands there is taken from range images of near, and from the one of the whole panel, if it was taken.
    """
    boxes = _before_panel(session, scans)
    grids = [_footprint_m(session.panel.object(name)) for name in group]
    return viewpoints.sides_by_sight(np.concatenate(grids), boxes)


def half_hidden(session: Session, names: Iterable[str], scans: Iterable[Scan]) -> list[str]:
    """Return the objects of which something before the panel hides much from a camera straight before them."""
    boxes = _before_panel(session, scans)
    return [name for name in names if _hidden_share(session.panel.object(name), boxes) > HIDDEN]


def _hidden_share(panel_object: PanelObject, boxes: Sequence[viewpoints.Box]) -> float:
    eye_m = np.array([*panel_object.position_m, viewpoints.CLOSE_UP_M])
    return viewpoints.hidden_share(eye_m, _footprint_m(panel_object), boxes)


def _before_panel(session: Session, scans: Iterable[Scan]) -> list[viewpoints.Box]:
    """Return the boxes around what range images show before the panel; none of one that does not show the plate."""
    found = list(session.world.obstacles or ())
    for image in scans:
        with suppress(PerceptionError, Unsupported):
            found += obstacles_in(session, image)
    panel_from_base = session.known_panel().parent_from_child.inv()
    return [(panel_from_base * one.parent_from_box, one.half_m) for one in found]


def _footprint_m(panel_object: PanelObject) -> Array:
    """Return points (N, 3) of the panel frame all over the footprint of an object."""
    half_x, half_y = panel_object.half_footprint_m
    x, y = np.meshgrid(np.linspace(-half_x, half_x, FOOTPRINT_POINTS), np.linspace(-half_y, half_y, FOOTPRINT_POINTS))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + panel_object.point_m


def surfaces_of_mission(session: Session, overview: ScannedPlane | None, *, is_touching: bool) -> SurfaceView | None:
    """Find the objects with a relief in a range image of the whole panel, or else in that of the overview."""
    image = ensure_space_is_known(session) if is_touching else None  # from the overview it is a short way
    if image is not None:
        with suppress(NotFound):
            return view_surfaces(session, plate_in(session, image), FACING)
    return None if overview is None else view_surfaces(session, overview, OVERVIEW)
