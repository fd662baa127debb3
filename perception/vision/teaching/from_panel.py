"""Teaching of looks from a known panel: its file and a view of it determine where every object is, without clicks.

Every object that is present teaches one look, at the sub-object nearest to its middle, because blind recognition will
search there. If no sub-object lies at the middle, as for a lever, the look includes the offset from the sub-object to
the middle: the paper's relations. Sub-objects that belong to no object teach the kind `nothing`. Only looks that the
others do not imply are kept (`condense`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from hal.errors import NotFound
from hal.panel import Panel, PanelObject
from perception.vision.finding.blind import Detection, candidate_places, chosen
from perception.vision.finding.features import PLATE_PX_PER_M, look_at
from perception.vision.image import as_gray
from perception.vision.inspection import inspect_view
from perception.vision.knowledge import NOTHING, Knowledge, TaughtKind
from perception.vision.knowledge_files import UNIT
from perception.vision.projection import CameraProjection, PanelProjection
from perception.vision.reading import ObjectReading
from perception.vision.registration.register import register
from perception.vision.teaching.condense import worth_keeping
from perception.vision.teaching.lesson import NOTHING_SIZE_M, SNAP_M, Overview, overview_of, under_pixels

# A sub-object this near to an object's middle belongs to the object, whichever of them blind recognition finds.
PART_M = 0.0067
FOOT_TO_TOP = np.array([0.0, 0.5, 1.0])  # shares of the height; a raised object appears between its foot and its top
LEAST_THERE = 0.5  # of the objects; in an image of a panel's left half 5 of 14 were present
NOT_DISTINCT = "nothing there stands out as a whole: come closer, or change the angle or the light"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownObject:
    """An object of the panel in the overview.

    Attributes:
        place_px: (2,) position of the sub-object that teaches, on the rectified plate.
        middle_m: (2,) offset from there to the object's middle on the plate; zero if the sub-object lies at the middle.
        centre_px, box_px: (2,) and (4, 2), the object in the image.
    """

    panel_object: PanelObject
    place_px: Array
    middle_m: Array
    centre_px: Array
    box_px: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PanelLooks:
    """Result of teaching from one overview of a known panel.

    Attributes:
        knowledge: with the new looks.
        added: number of new looks per kind.
        shown: the objects that taught, in the order of the panel file.
        left_out: reason why an object did not teach, by name.
        known_before, known_now: names of the objects that blind recognition finds in this overview without and with
            the new looks. The second shows that they were learned, not how well they work in other overviews.
    """

    knowledge: Knowledge
    added: dict[str, int]
    shown: tuple[ShownObject, ...]
    left_out: dict[str, str]
    known_before: tuple[str, ...]
    known_now: tuple[str, ...]

    @property
    def kinds(self) -> tuple[TaughtKind, ...]:
        """The kinds that got new looks."""
        return tuple(kind for kind in self.knowledge.kinds if kind.name in self.added)


def teach_from_panel(
    image: NDArray[Any], view: PanelProjection, panel: Panel, knowledge: Knowledge, *, source: str = ""
) -> PanelLooks:
    """Learn the looks of the objects of a known panel from an overview of it.

    Args:
        image: overview, gray or RGB uint8, with the plate's border in view.
        view: projection of the panel, good to a few pixels.
        source: a remark for the files of new kinds.

    Raises:
        InvalidRequest, NotObservable: bad image.
        NotFound, Ambiguous: the image shows no plate, or two; or not this panel at that pose; or none of its objects.
    """
    gray = as_gray(image)
    focal_px = view.intrinsics.fx_px if isinstance(view, CameraProjection) else None
    overview = overview_of(gray, plate_m=(panel.width_m, panel.height_m), focal_px=focal_px)
    registered = register(gray, view, panel).view
    readings = inspect_view(image, gray, registered, panel)
    _check_most_are_there(readings, panel)
    places = candidate_places(overview.ground)
    shown, left_out = _objects(overview, registered, panel, readings, places)
    if not shown:
        raise NotFound(
            f"none of panel {panel.name!r}'s objects shows in the image: {next(iter(left_out.values()), 'it has none')}",
            hint="take an overview that shows the whole panel in focus and in even light",
        )
    grown, added = _grown(overview, shown, _of_nothing(overview, registered, panel, shown, places), knowledge, source)
    before, now = (_recognised(overview, places, shown, known) for known in (knowledge, grown))
    return PanelLooks(knowledge=grown, added=added, shown=shown, left_out=left_out, known_before=before, known_now=now)


def _check_most_are_there(readings: Sequence[ObjectReading], panel: Panel) -> None:
    """Check that most objects are present.

    Raises:
        NotFound: they are not. The image then shows something else, or the border was found wrongly; a few objects may
            appear present by chance.
    """
    there = sum(reading.present for reading in readings)
    if 0 < there < LEAST_THERE * len(readings):
        raise NotFound(
            f"only {there} of the {len(readings)} objects of panel {panel.name!r} are where its file has them",
            hint="take an overview that shows the whole panel with its border; is it this panel?",
        )


def _objects(
    overview: Overview, view: PanelProjection, panel: Panel, readings: Sequence[ObjectReading], places: Array
) -> tuple[tuple[ShownObject, ...], dict[str, str]]:
    """Return the objects that can teach, and the reason why each of the others cannot."""
    shown: list[ShownObject] = []
    left_out: dict[str, str] = {}
    for panel_object, reading in zip(panel.objects, readings, strict=True):
        if not reading.present:
            left_out[panel_object.name] = reading.reason or "it is not seen"
            continue
        shift_px = reading.centre_px - view.project([panel_object.point_m])[0]
        found = _nearest_sub_object(overview, view, panel_object, shift_px, places)
        if found is None:
            left_out[panel_object.name] = NOT_DISTINCT
            continue
        place, middle_m = found
        (left, top), (right, bottom) = _box(overview, view, panel_object, shift_px)
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        shown.append(
            ShownObject(
                panel_object=panel_object,
                place_px=place,
                middle_m=middle_m,
                centre_px=overview.in_image(overview.on_plate(place[None]) + middle_m)[0],
                box_px=overview.in_image(overview.on_plate(corners)),
            )
        )
    return tuple(shown), left_out


def _nearest_sub_object(
    overview: Overview, view: PanelProjection, panel_object: PanelObject, shift_px: Array, places: Array
) -> tuple[Array, Array] | None:
    """Return the position of the sub-object that teaches, and the offset from it to the object's middle.

    None if there is none. It is the sub-object at the object's middle. If there is none, as for a slider or a lever, it
    is the nearest one inside the object's box.
    """
    x, y = panel_object.position_m
    stem = np.column_stack([np.tile([x, y], (3, 1)), panel_object.face.height_m * FOOT_TO_TOP])
    line = _on_ground(overview, view.project(stem) + shift_px)
    away = np.linalg.norm(places[:, None] - line, axis=2)
    is_near = away.min(axis=1) < SNAP_M * PLATE_PX_PER_M
    if is_near.any():
        return np.asarray(places[int(np.where(is_near, away[:, 1], np.inf).argmin())]), np.zeros(2)
    low, high = _box(overview, view, panel_object, shift_px)
    is_near = ((places >= low) & (places <= high)).all(axis=1)
    if not is_near.any():
        return None
    place = places[int(np.where(is_near, away[:, 1], np.inf).argmin())]
    middle_m = overview.on_plate(line[1:2])[0] - overview.on_plate(place[None])[0]
    return np.asarray(place), np.round(middle_m, 4)


def _box(overview: Overview, view: PanelProjection, panel_object: PanelObject, shift_px: Array) -> Array:
    """Return the lowest and highest u and v (2, 2) of the object's box, foot to top, on the rectified plate."""
    face = panel_object.face
    half_width, half_height, height = face.half_width_m, face.half_height_m, face.height_m
    corners = np.array([[i, j, k] for i in (-1.0, 1.0) for j in (-1.0, 1.0) for k in (0.0, 1.0)])
    box = corners * [half_width, half_height, height] + [*panel_object.position_m, 0.0]
    at = _on_ground(overview, view.project(box) + shift_px)
    return np.stack([at.min(axis=0), at.max(axis=0)])


def _on_ground(overview: Overview, pixels: Array) -> Array:
    """Convert pixels (N, 2) of the image to pixels of the rectified plate."""
    return overview.on_ground(under_pixels(overview.view, pixels, overview.plate_m))


def _of_nothing(
    overview: Overview, view: PanelProjection, panel: Panel, shown: Sequence[ShownObject], places: Array
) -> Array:
    """Return the looks (N, LENGTH) of the sub-objects that belong to no object, shown or not."""
    middles = np.array([each.place_px for each in shown])
    away = np.linalg.norm(places[:, None] - middles, axis=2).min(axis=1)
    is_nothing = away > PART_M * PLATE_PX_PER_M
    names = {each.panel_object.name for each in shown}
    for panel_object in panel.objects:
        if panel_object.name not in names:
            low, high = _box(overview, view, panel_object, np.zeros(2))
            is_nothing &= ~((places >= low) & (places <= high)).all(axis=1)
    return look_at(overview.ground, places[is_nothing])


def _grown(
    overview: Overview, shown: Sequence[ShownObject], nothing: Array, knowledge: Knowledge, source: str
) -> tuple[Knowledge, dict[str, int]]:
    """Return the knowledge with the looks that it does not imply yet, and the number of new looks per kind."""
    own = look_at(overview.ground, np.array([each.place_px for each in shown]))
    looks = np.round(np.vstack([own, nothing]) * UNIT) / UNIT  # as the files have them
    names = np.array([each.panel_object.kind for each in shown] + [NOTHING] * len(nothing))
    added: dict[str, int] = {}
    grown = knowledge
    known = knowledge.for_image(noisy=overview.ground.noisy)
    for k in np.sort(worth_keeping(looks, names, knowledge.spread, known=known)):
        name = str(names[k])
        size_m, middles_m = NOTHING_SIZE_M, None
        if name != NOTHING:
            face = shown[k].panel_object.face
            half_width, half_height = face.half_width_m, face.half_height_m
            size_m = (2.0 * half_width, 2.0 * half_height)
            middles_m = shown[k].middle_m[None] if shown[k].middle_m.any() else None
        grown = grown.grown(
            TaughtKind(name=name, size_m=size_m, looks=looks[k : k + 1], taught_by=source, middles_m=middles_m)
        )
        added[name] = added.get(name, 0) + 1
    return grown, added


def _recognised(
    overview: Overview, places: Array, shown: Sequence[ShownObject], knowledge: Knowledge
) -> tuple[str, ...]:
    """Return the names of the objects that blind recognition finds in this overview."""
    looks = look_at(overview.ground, places)
    found = chosen(overview.ground, places, looks, knowledge, overview.view, overview.plate_m)
    return tuple(each.panel_object.name for each in shown if any(_is(each, candidate) for candidate in found))


def _is(shown: ShownObject, candidate: Detection) -> bool:
    """Return whether a detection is the given object."""
    if candidate.reason is not None or candidate.kind != shown.panel_object.kind:
        return False
    reach_px = 0.5 * float(np.ptp(shown.box_px, axis=0).max())
    return bool(np.linalg.norm(candidate.centre_px - shown.centre_px) < reach_px)
