"""Reads the panel: finds the objects in an overview, reads them in close-ups, and looks past what hides them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hal.devices import DeviceKind
from hal.errors import NotFound, PerceptionError, Unreachable
from hal.geometry import compose
from hal.panel import PanelObject, Toggle
from manipulation import visiting_order
from perception.vision import (
    CameraProjection,
    ObjectReading,
    PanelProjection,
    answer_at,
    draw_annotated,
    merge_views,
    said,
    viewpoints,
)
from perception.vision import inspect as inspect_image
from service.operations.acquisition import FURTHER, Look, Scan, camera_over_panel, in_better_light, look, settle
from service.operations.locate import go_to_overview, locate_from_overview, offset_m
from service.operations.range_detection import half_hidden, read_by_height, scan_beside, sides_by_sight
from service.operations.session import Session, panel_object_or_all
from service.operations.stored import object_result, read_stored
from service.operations.travel import go_to_camera_view, skill_context
from service.report.plots import cut_out, png_of
from service.report.upright import quarter_turns, turned_image, turned_points
from service.schema.mission_results import ObjectPlace, ReadingResult
from service.schema.requests import InspectRequest, RecogniseRequest
from service.schema.results import InspectResult

TIPS_M = 0.085  # least distance of the finger tips from the plate in a side view, because cables hang in front of it
TURNED = "an earlier look showed the other state: look from the side, where the bat is not seen from its end"
OBJECTS = "objects of the panel file in the image"
MOST_UNREAD = 4  # if more objects cannot be read at once, the cause is the light or the lens and not a cable


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AnnotatedView:
    """One image for people: upright RGB, uint8 (H, W, 3), with its `readings` drawn in; and the image that it was made from.

    `turns` is by how many quarters to the left the image was turned, `view` where the image shows the panel.
    """

    title: str
    pixels: NDArray[np.uint8]
    look: Look
    view: PanelProjection
    readings: tuple[ObjectReading, ...] = ()
    turns: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Inspection:
    """The readings from one or several images, with one picture per image.

    `offset_m` is how far the last image shows the panel from its estimated pose; see `offset_m`. `scans` are range images
    that were taken from the same poses.
    """

    readings: dict[str, ObjectReading]
    pictures: tuple[AnnotatedView, ...]
    scans: tuple[Scan, ...] = ()
    offset_m: float = 0.0

    def crops(self) -> dict[str, bytes]:
        """Return an upright picture (PNG) of each object, from the last image in which it was read, else from the first."""
        shown: dict[str, bytes] = {}
        for picture in self.pictures:
            for reading in picture.readings:
                cut = cut_out(picture.look.pixels, reading.outline_px)
                if cut is not None and (reading.name not in shown or reading.answered):
                    shown[reading.name] = png_of(turned_image(cut, picture.turns))
        return shown

    def surroundings(self, panel_object: PanelObject) -> bytes | None:
        """Return a picture (PNG) of an object and the plate around it, for teaching; from the first image, which is frontal.

        None if that image does not show all of it.
        """
        from perception.vision.teaching import surroundings

        for picture in self.pictures:
            for reading in picture.readings:
                if reading.name == panel_object.name:
                    centre_px = reading.centre_px if reading.present else [np.nan, np.nan]
                    found = surroundings(picture.look.pixels, picture.view, panel_object.point_m, centre_px)
                    return None if found is None else png_of(found)
        return None


def inspect_here(
    session: Session,
    names: Collection[str],
    seen: Look | None = None,
    *,
    title: str = OBJECTS,
) -> Inspection:
    """Read objects from the present pose of the camera."""
    view = seen or look(session)
    camera_from_panel = compose(view.base_from_camera.inverse(), session.known_panel())
    try:
        readings = inspect_image(
            view.pixels,
            view.intrinsics,
            camera_from_panel,
            session.panel,
            names=names,
            previous=session.world.readings,
        )
    except PerceptionError:
        settle(session)
        look(session, view.camera)  # raises if the camera is frozen, which a second identical frame shows
        raise
    session.world.note_readings(readings)
    turns = quarter_turns(camera_from_panel.parent_from_child)
    drawn = _upright_drawing(view, readings, turns)
    shows = CameraProjection(intrinsics=view.intrinsics, camera_from_panel=camera_from_panel)
    picture = AnnotatedView(title=title, pixels=drawn, look=view, view=shows, readings=tuple(readings), turns=turns)
    off_m = offset_m(view, readings, session.known_panel().parent_from_child, session.panel)
    return Inspection(readings={r.name: r for r in readings}, pictures=(picture,), offset_m=off_m)


def _upright_drawing(view: Look, readings: Iterable[ObjectReading], turns: int) -> NDArray[np.uint8]:
    size_px = (view.pixels.shape[1], view.pixels.shape[0])
    turned = [replace(one, outline_px=turned_points(one.outline_px, size_px, turns)) for one in readings]
    return draw_annotated(turned_image(view.pixels, turns), turned)


def inspect_close(session: Session, names: Collection[str]) -> Inspection:
    """Read objects from close-ups, and those that cannot be read there from the sides."""
    before = session.world.readings
    return look_past(session, _doubting_turned_bats(session, before, close_ups(session, names)))


def _doubting_turned_bats(session: Session, before: Mapping[str, ObjectReading], found: Inspection) -> Inspection:
    """Refuse the toggles that an earlier look showed in their other state, because a bat seen from its end deceives."""
    deceptive = {
        name: reading.in_doubt(TURNED)
        for name, reading in found.readings.items()
        if isinstance(session.panel.object(name), Toggle) and _contradicts(before.get(name), reading)
    }
    for name in deceptive:
        session.world.forget_reading(name)
    return replace(found, readings=found.readings | deceptive)


def _contradicts(before: ObjectReading | None, now: ObjectReading) -> bool:
    return before is not None and now.answered and before.state not in (None, now.state)


def close_ups(session: Session, names: Collection[str]) -> Inspection:
    """Read objects from the fewest images that show all of them finely enough."""
    objects = [session.panel.object(name) for name in names]
    distance_m = viewpoints.reading_distance_m(session.lens())
    groups = viewpoints.close_up_groups(objects, session.lens(), distance_m)
    groups = [groups[k] for k in visiting_order(camera_over_panel(session), [centre_m for centre_m, _ in groups])]
    readings: dict[str, ObjectReading] = {}
    pictures: list[AnnotatedView] = []
    scans: list[Scan] = []
    for k, (centre_m, group) in enumerate(groups):
        session.progress(k / len(groups), "close-up", ", ".join(group))
        closer = look_close(session, centre_m, group, distance_m=distance_m)
        readings |= closer.readings
        pictures += closer.pictures
        scans += scan_beside(session)
    return Inspection(readings=readings, pictures=tuple(pictures), scans=tuple(scans))


def look_close(
    session: Session,
    centre_m: Iterable[float],
    names: Collection[str],
    *,
    distance_m: float = viewpoints.CLOSE_UP_M,
) -> Inspection:
    """Drive the camera to a distance before a panel point and read the named objects there."""
    pose = session.known_panel().parent_from_child
    title = f"close-up of {', '.join(names)}"
    go_to_camera_view(session, viewpoints.close_up_poses(pose, tuple(centre_m), distance_m), name=title[:60])
    settle(session)
    return inspect_exposed(session, names, title=title)


def inspect_exposed(
    session: Session, names: Collection[str], *, title: str = OBJECTS, further: int = FURTHER
) -> Inspection:
    """Read objects from the present pose of the camera, and with other exposures those that are too dark or too bright.

    `further`: how many looks there may be after the first.
    """
    seen = look(session)
    try:
        found = inspect_here(session, names, seen, title=title)
    except PerceptionError:  # too little of the panel is visible
        better = in_better_light(session, seen) if further > 0 else None
        if better is None:
            raise
        with better:
            return inspect_exposed(session, names, title=title, further=further - 1)
    unread = [one for one in found.readings.values() if not (one.answered or one.needs_closer_sides)]
    outlines_px = [one.outline_px for one in unread]
    better = in_better_light(session, seen, outlines_px) if unread and further > 0 else None
    if better is None:
        return found
    with better:
        other = f"{', '.join(one.name for one in unread)} with another exposure"
        again = inspect_exposed(session, [one.name for one in unread], title=other, further=further - 1)
    told = {one.name: merge_views([one, again.readings[one.name]]) for one in unread}
    return replace(found, readings=found.readings | told, pictures=(*found.pictures, *again.pictures))


def look_past(session: Session, found: Inspection) -> Inspection:
    """Look from the sides at objects that are present but could not be read, until they can be read.

    So are objects that were read though something hides much of them; the looks must agree then. The side from which the
    least of them is hidden comes first, where range images show what hides them. Of objects of which two states look alike,
    a range image shows the height; those that it does not decide are looked at from a shorter distance.
    """
    unread = [reading for reading in found.readings.values() if reading.present and not reading.answered]
    if len(unread) > MOST_UNREAD:
        return found
    read = [one.name for one in found.readings.values() if one.answered]
    doubtful = half_hidden(session, read, found.scans) if found.scans else []
    looks = {name: [found.readings[name]] for name in (*(one.name for one in unread), *doubtful)}
    for name in doubtful:
        session.world.forget_reading(name)  # it would decide the second look as well
    by_height = read_by_height(session, [one for one in unread if one.needs_closer_sides], found.scans)
    alike = [reading.name for reading in unread if reading.needs_closer_sides and reading.name not in by_height]
    hidden = [reading.name for reading in unread if not reading.needs_closer_sides]
    pictures = list(found.pictures)
    ways = (
        (hidden, (), viewpoints.CLOSE_UP_M),
        (alike, viewpoints.CLOSE_SIDES, viewpoints.NEAR_M),
        (doubtful, (), viewpoints.CLOSE_UP_M),
    )
    for names, sides, distance_m in ways:
        objects = [session.panel.object(name) for name in names]
        for _, group in viewpoints.close_up_groups(objects, session.lens(), distance_m):
            seen_past = sides or sides_by_sight(session, group, found.scans)
            pictures += _from_the_sides(session, group, looks, seen_past)
    told = {name: _told(each) for name, each in looks.items()} | by_height
    for name in told:
        session.world.forget_reading(name)  # a single image may have given a reading that the others contradict
    readings = found.readings | told
    session.world.note_readings(readings.values())
    return replace(found, readings=readings, pictures=tuple(pictures))


def _from_the_sides(
    session: Session,
    group: Collection[str],
    looks: dict[str, list[ObjectReading]],
    sides: Sequence[str],
) -> Iterator[AnnotatedView]:
    """Yield pictures from each side that the arm reaches, until all objects are read; appends readings to `looks`."""
    flange_from_camera = session.mount(session.first(DeviceKind.CAMERA)).parent_from_child
    camera_from_tips = flange_from_camera.inv() * skill_context(session).flange_from_grip
    pose = session.known_panel().parent_from_child
    middle_m = np.mean([session.panel.object(name).point_m for name in group], axis=0)
    unread = list(group)
    for side in sides:
        title = f"{', '.join(unread)} from {side}"
        session.progress(1.0, "look past what hides it", title)
        poses = viewpoints.poses_from(pose, tuple(middle_m), side)
        clear = (view for view in poses if (pose.inv() * view * camera_from_tips).translation[2] >= TIPS_M)
        try:
            go_to_camera_view(session, clear, name=title[:60])
            settle(session)
            closer = inspect_exposed(session, unread, title=title)
        except (PerceptionError, Unreachable):
            continue
        yield from closer.pictures
        for name in unread:
            looks[name].append(closer.readings[name])
        unread = [name for name in unread if not merge_views(looks[name]).answered]
        if not unread:
            return


def _told(looks: Sequence[ObjectReading]) -> ObjectReading:
    """Return the reading that results from the frontal view and the side views together."""
    told = merge_views(looks)
    if told.answered or len(looks) == 1:
        return told
    return replace(told, reason=f"{told.reason} ({len(looks) - 1} views from the sides did not help)")


def reading_result(reading: ObjectReading, when: str) -> ReadingResult:
    """Return a reading in the form of the report."""
    return ReadingResult(
        name=reading.name,
        kind=reading.kind,
        present=reading.present,
        shows=said(reading),
        value=reading.value,
        unit=reading.unit,
        uncertainty=reading.uncertainty,
        state=reading.state,
        text=reading.text,
        confidence=reading.confidence,
        reason=reading.reason,
        when=when,
    )


def run_inspect(session: Session, request: InspectRequest) -> InspectResult:
    """Run the verb `inspect`."""
    if request.image is not None:
        session.progress(0.1, "look at the stored image")
        return read_stored(session, request)
    names = panel_object_or_all(session.panel, request.objects)
    ensure_located(session.part(0.0, 0.3))
    found = inspect_close(session.part(0.3, 1.0), names) if request.close_up else inspect_here(session, names)
    return _answer(session, found, request.least_confidence)


def run_recognise_taught(session: Session, request: RecogniseRequest) -> InspectResult:
    """Run the verb `recognise` by vision with a taught panel."""
    names = panel_object_or_all(session.panel, request.objects)
    if request.move:
        ensure_located(session.part(0.0, 0.5))
        session.progress(0.5, "drive to the overview")
        go_to_overview(session)
        settle(session)
    session.progress(0.8, "recognise")
    return _answer(session, inspect_here(session, names, look(session, request.camera)), request.least_confidence)


def ensure_located(session: Session) -> None:
    """Locate the panel unless its pose is known already."""
    if session.world.base_from_panel is not None:
        return
    session.progress(0.1, "drive to the overview")
    go_to_overview(session)
    locate_from_overview(session.part(0.3, 1.0))


def tell(
    session: Session, readings: Iterable[ObjectReading], found: Inspection, *, mission: str = "", phase: str = ""
) -> None:
    """Give readings to the observer with what an inspection shows of them; see `Observer.saw`."""

    def around(name: str) -> bytes | None:
        return found.surroundings(session.panel.object(name))

    session.observer.saw(readings, found.crops(), around, mission=mission, phase=phase)


def missing(readings: Iterable[ObjectReading], wanted: Iterable[PanelObject]) -> tuple[str, ...]:
    """Return the names of objects that are not where the panel file says."""
    present = {r.name for r in readings if r.present}
    return tuple(panel_object.name for panel_object in wanted if panel_object.name not in present)


def need_all_present(found: Inspection, session: Session) -> None:
    """Raise `NotFound` if an object is missing; the error names it.

    It would be dangerous to operate a panel that differs from its file.
    """
    lost = missing(found.readings.values(), session.panel.objects)
    if lost:
        raise NotFound(
            f"{', '.join(lost)} {'is' if len(lost) == 1 else 'are'} not where the file of panel {session.panel.name!r} says",
            hint="check the panel file, and that nothing hides the objects: see the annotated picture",
            objects=list(lost),
        )


def _answer(session: Session, found: Inspection, least_confidence: float) -> InspectResult:
    """Return the answer at the caller's least confidence; stored readings and pictures keep the default."""
    tell(session, found.readings.values(), found)
    readings = [answer_at(reading, least_confidence) for reading in found.readings.values()]
    pictures = [
        session.context.task.artefact(f"annotated-{k}.png", png_of(picture.pixels), "image/png")
        for k, picture in enumerate(found.pictures)
    ]
    asked = [panel_object for panel_object in session.panel.objects if panel_object.name in found.readings]
    return InspectResult(
        objects=[object_result(reading, session.world.base_from_panel) for reading in readings],
        missing=list(missing(found.readings.values(), asked)),
        pictures=pictures,
    )


def places_in(session: Session, found: Inspection) -> list[ObjectPlace]:
    """Return the position of every object in the base frame, m."""
    pose = session.known_panel().parent_from_child
    return [
        ObjectPlace(name=r.name, kind=r.kind, centre_in_base_m=pose.apply(r.centre_m))
        for r in found.readings.values()
        if r.centre_m is not None
    ]
