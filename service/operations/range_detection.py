"""Finds objects of the panel file by their surfaces in a range image and compares them with panel file and vision.

This covers the kinds with a relief, such as mushroom buttons and handwheels. An object that is not found, or is found
in another place, is scanned again from a shorter distance. The panel file is not corrected: an object that is still
found in another place is reported and not operated.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform
from scipy.special import chdtri

from hal.devices import DeviceKind
from hal.errors import NotFound, PerceptionError, Unreachable, Unsupported
from hal.geometry import UncertainPose, compose
from hal.panel import Panel, PanelObject
from perception.range import PanelView, PinholeSensor, RangeScene, Sighting, Surface, analyse, find_objects
from perception.vision import ObjectReading, viewpoints
from service.operations.acquisition import Scan, settle
from service.operations.locate import ScannedPlane, scan_plate
from service.operations.session import Session
from service.operations.travel import go_to_first
from service.report.plots import png_of
from service.report.record import Picture
from service.report.surfaces import Mark, surfaces_picture
from service.schema.mission_results import SurfaceCheck

OUTLINE_POINTS = 48  # points of the circle that is drawn around an object
ELSEWHERE_P = 1e-3  # probability that an object in its right place is scanned twice
TURN_SLACK_RAD = 0.1  # allowed between a wheel's angle by its spokes and by its mark, in addition to three sigmas
OVERVIEW, CLOSER = "the overview", "a closer look"


def surfaces_in(image: Scan) -> RangeScene:
    """Segment a range image into surfaces.

    Raises:
        Unsupported: the image is not a pinhole projection.
        InvalidRequest, NotFound: see `analyse`.
    """
    c = image.capabilities
    if c.projection != "pinhole":
        raise Unsupported(f"{image.scanner} has {c.projection} projection", hint="use a pinhole range scanner")
    sensor = PinholeSensor(width_px=c.width, height_px=c.height, fx_px=c.fx, fy_px=c.fy, cx_px=c.cx, cy_px=c.cy)
    return analyse(image.depth_m, sensor)


def find_by_surfaces(
    scene: RangeScene, image: Scan, panel: Panel, base_from_panel: UncertainPose, plate: Surface
) -> list[Sighting]:
    """Find the panel's objects with a relief in a scan; see `find_objects`."""
    depth_m = np.asarray(image.depth_m, float)
    view = PanelView(
        scene=scene,
        depth_m=depth_m,
        base_from_sensor=image.base_from_scanner,
        plate=plate,
        base_from_panel=base_from_panel,
    )
    return find_objects(panel, view)


def mark_of(sighting: Sighting, image: Scan, base_from_panel: UncertainPose) -> Mark:
    """Return the object's outline at its height, where it was found or else where it was looked for."""
    panel_object = sighting.panel_object
    found = sighting.base_from_object
    base_from_object = (
        found.parent_from_child
        if found is not None
        else base_from_panel.parent_from_child * RigidTransform.from_translation([*panel_object.position_m, 0.0])
    )
    turn = np.linspace(0.0, 2.0 * np.pi, OUTLINE_POINTS, endpoint=False)
    radius, relief = max(panel_object.half_footprint_m), panel_object.relief
    height_m = 0.0 if relief is None else relief.height_m
    ring = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(OUTLINE_POINTS, height_m)], axis=-1)
    x, y, z = (image.base_from_scanner.parent_from_child.inv() * base_from_object).apply(ring).T
    c, depth = image.capabilities, np.maximum(z, 1e-3)
    return Mark(
        outline_px=np.stack([c.fx * x / depth + c.cx, c.fy * y / depth + c.cy], axis=-1),
        text=panel_object.name if sighting.match is not None else f"{panel_object.name}: {sighting.why}",
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


def check_surfaces(session: Session, first: SurfaceView) -> tuple[list[SurfaceCheck], list[Picture]]:
    """Compare the objects seen from the overview; scan those again that disagree or were not found.

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
            again = _look_closer(session, sighting.panel_object)
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
    panel_object, match = sighting.panel_object, sighting.match
    if match is None or sighting.base_from_object is None:
        return SurfaceCheck(
            name=panel_object.name, kind=panel_object.kind, seen_from=place, found=False, agrees=None, centre_in_base_m=None,
            off_m=None, sigma_m=None, chi_square=None, off_vision_m=None, shows=None, vision_shows=_said(panel_object, reading),
            stands_elsewhere=False,
            finding=f"not found by its surfaces: {sighting.why}",
        )  # fmt: skip
    panel_from_object = compose(base_from_panel.inverse(), sighting.base_from_object)
    x, y, z = sighting.base_from_object.parent_from_child.translation
    at_m = panel_from_object.parent_from_child.translation[:2]
    off = at_m - panel_object.position_m
    C = panel_from_object.covariance[:2, :2] + position_m**2 * np.eye(2)
    chi_square = float(off @ np.linalg.solve(C, off))
    is_elsewhere = bool(chi_square > chdtri(2, ELSEWHERE_P))
    shows_alike = _shows_alike(sighting, reading)
    off_m, sigma_m = float(np.linalg.norm(off)), float(np.sqrt(0.5 * np.trace(C)))
    seen = None if reading is None or reading.centre_m is None else reading.centre_m[:2]
    shows, vision_shows = _shown(sighting), _said(panel_object, reading)
    finding = f"stands {1e3 * off_m:.1f} mm from its place in the panel file (1 sigma {1e3 * sigma_m:.1f} mm)"
    if not shows_alike:
        finding += f"; shows {shows} by its surfaces and {vision_shows} by vision"
    return SurfaceCheck(
        name=panel_object.name, kind=panel_object.kind, seen_from=place, found=True, agrees=shows_alike and not is_elsewhere,
        centre_in_base_m=(float(x), float(y), float(z)), off_m=off_m, sigma_m=sigma_m, chi_square=chi_square,
        off_vision_m=None if seen is None else float(np.linalg.norm(at_m - seen)),
        shows=shows, vision_shows=vision_shows, stands_elsewhere=is_elsewhere, finding=finding,
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
    relief, match, state = sighting.panel_object.relief, sighting.match, sighting.state
    if relief is None or match is None or state is None or reading is None or not reading.answered:
        return True
    if relief.motion == "slide":
        return reading.state is None or _shown(sighting) == reading.state
    if reading.value is None:
        return True
    spoke = 2.0 * np.pi / relief.turns
    apart = abs((state - reading.value + 0.5 * spoke) % spoke - 0.5 * spoke)
    sigma = np.hypot(match.state_sigma or 0.0, reading.uncertainty or 0.0)
    return bool(apart <= TURN_SLACK_RAD + 3.0 * sigma)


def _look_closer(session: Session, panel_object: PanelObject) -> SurfaceView | str:
    """Scan the object from a pose perpendicular to it; returns the reason as text when that is not possible."""
    flange_from_scanner = session.mount(session.first(DeviceKind.RANGE_SCANNER)).parent_from_child
    views = viewpoints.close_up_poses(session.known_panel().parent_from_child, panel_object.point_m)
    try:
        go_to_first(
            session, (v * flange_from_scanner.inv() for v in views), name=f"closer look at {panel_object.name}"[:60]
        )
        settle(session)
        return view_surfaces(session, scan_plate(session), CLOSER)
    except (PerceptionError, Unreachable) as error:
        return error.what


def _picture(session: Session, view: SurfaceView, name: str) -> Picture:
    marks = [mark_of(s, view.scan, session.believed_panel()) for s in view.sightings]
    title = f"surfaces in the range image from {view.place}, and the objects of the panel file in it"
    return Picture(name=name, title=title, png=png_of(surfaces_picture(view.scene, marks)))
