"""Reads the one instrument that is somewhere in an ordinary picture; also what kind it is, if that is not told."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.errors import NotObservable
from perception.vision.image import as_gray
from perception.vision.photographs.dial import MOVES
from perception.vision.photographs.faces import Face, find_faces
from perception.vision.photographs.photo_display import read_segments
from perception.vision.reading import PatchReading, SeenFace, answer_at, doubted, limited, refused

ReadFace = Callable[[Image], PatchReading]

CLEAR = 0.6  # confidence from which a second instrument makes the picture ambiguous
# Least confidence and number of digits of a display whose kind was not told, because edges and words resemble digits.
DISPLAY_CLEAR, LEAST_DIGITS = 0.8, 2
DISPLAY_MOST = 0.75  # highest confidence of such a display
GUESSED_MOST = 0.75  # highest confidence of a face whose pivot is guessed
STEEP_MOST = 0.75  # highest confidence of a face that is seen steeply
CONTRADICTED, CONTRADICTED_MOST = 0.025, 0.75  # of the scale, between two outlines; and highest confidence then
TURNED = 2  # of the faces found first, which are looked at with other places of their pivots
LEAST_FACE_PX = 24.0  # radius of a face that may be read
NOTHING = (
    "no instrument is found in the picture: come closer, crop the picture to the instrument, or say which kind it is"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Seen:
    """A face that was read, and its reading, with its place in the whole picture."""

    face: Face
    reading: PatchReading

    @property
    def rank(self) -> tuple[bool, float, float]:
        """Whether it was read by numerals, how surely, and how much of its outline has an edge.

        What else is round is no instrument beside one that has numerals.
        """
        scale = self.reading.scale
        by_numerals = self.reading.answered and scale is not None and scale.by_numerals
        return by_numerals, self.reading.confidence, self.face.coverage

    def contradicts(self, other: _Seen) -> bool:
        """Return whether another face of the same instrument was read as clearly, and shows another value."""
        scale, one, two = self.reading.scale, self.reading.value, other.reading.value
        if self.rank[0] != other.rank[0] or other.rank[1] < CLEAR or not _overlap(self.face, other.face):
            return False
        return (
            scale is not None
            and one is not None
            and two is not None
            and (abs(one - two) > CONTRADICTED * abs(scale.maximum - scale.minimum))
        )


def read_face_anywhere(image: Image, read: ReadFace, *, is_scene: bool) -> PatchReading:
    """Read the one round face in a picture by `read`, which reads a face that fills a picture.

    Args:
        image: (H, W) gray or (H, W, 3) RGB uint8.
        is_scene: whether the face does certainly not fill the picture.
    """
    return _one_of(_read_faces(image, read, is_scene=is_scene)) or refused(NOTHING)


def read_anything(image: Image, read: ReadFace, least_confidence: float) -> PatchReading:
    """Read the one round face or the one display in a picture; arguments as of `read_face_anywhere` and `answer_at`."""
    seen = _read_faces(image, read, is_scene=False)
    face = _one_of(seen)
    # Numerals on a face are no digits of a display.
    rest = _without([one.face for one in seen if one.reading.answered or one.face.is_clear], as_gray(image))
    if face is None or not face.answered:
        display = _display(rest, (True, False))
        if display is None:
            return face or refused(NOTHING)
        return answer_at(limited(display, DISPLAY_MOST), least_confidence)
    beside = _display(rest, (True,))
    return face if beside is None else doubted(face, _several([_told(face), f"a display with {beside.text}"]))


def _display(gray: Image, ways: Sequence[bool]) -> PatchReading | None:
    """Return the clear number of seven segments in a picture; None without one.

    `ways`: whether it is looked for in a scene, or fills the picture.
    """
    found = [one for is_scene in ways if (one := read_segments(gray, scene=is_scene)) is not None]
    best = max(found, key=lambda one: one.confidence, default=None)
    if best is None or best.text is None or best.confidence < DISPLAY_CLEAR:
        return None
    return best if sum(character.isdigit() for character in best.text) >= LEAST_DIGITS else None


def _read_faces(image: Image, read: ReadFace, *, is_scene: bool) -> list[_Seen]:
    """Return the faces in a picture with their readings, without those that are too small, black or saturated.

    If numerals show the scale of none of them, and no needle moves, the first ones are looked at with other places of their
    pivots.
    """
    filling = None if is_scene else _filling(image, read)
    faces = [face for face in find_faces(image) if face.size_px >= LEAST_FACE_PX]
    seen = [one for face in faces if (one := _seen(image, face, read)) is not None]
    found = seen if filling is None else [filling, *seen]
    if any(one.rank[0] or one.reading.reason == MOVES for one in found):
        return found
    return [*found, *_guessed(image, faces[:TURNED], read)]


def _guessed(image: Image, faces: Sequence[Face], read: ReadFace) -> Iterator[_Seen]:
    """Yield the faces whose numerals show their scale if their pivots are elsewhere; what is read then is never sure."""
    for face in faces:
        for other in face.otherwise(max(image.shape[:2])):
            seen = _seen(image, other, read)
            if seen is not None and seen.rank[0]:
                yield replace(seen, reading=limited(seen.reading, GUESSED_MOST))


def _seen(image: Image, face: Face, read: ReadFace) -> _Seen | None:
    """Return a face as seen from straight ahead; None if nothing is found there, or the picture is black or saturated."""
    view, image_from_view = face.view(image)
    try:
        reading = read(view)
    except NotObservable:
        return None
    if reading.face is None:
        return None
    seen = replace(reading, face=reading.face.moved(image_from_view))
    return _Seen(face=face, reading=limited(seen, STEEP_MOST) if face.is_steep else seen)


def _filling(image: Image, read: ReadFace) -> _Seen | None:
    """Return the reading of a face that fills the picture; None if nothing there is read, nor doubted."""
    reading = read(image)
    if reading.face is None or not (reading.answered or reading.guess):
        return None
    at = reading.face
    rim = np.column_stack([at.right, np.negative(at.up)])
    return _Seen(face=Face(middle=np.array(at.middle), rim=rim, coverage=0.0), reading=reading)


def _one_of(seen: Sequence[_Seen]) -> PatchReading | None:
    """Return the reading of the instrument in a picture; a refusal if there are several, None if there is none."""
    read = sorted((one for one in seen if one.reading.answered), key=lambda one: one.rank, reverse=True)
    if not read:
        return max((one.reading for one in seen), key=lambda one: one.confidence, default=None)
    best = read[0]
    others = [
        one for one in read[1:]
        if one.rank[0] == best.rank[0] and one.rank[1] >= CLEAR and not _overlap(one.face, best.face)
    ]  # fmt: skip
    if others:
        return doubted(best.reading, _several([_told(one.reading) for one in (best, *others)]))
    if any(best.contradicts(one) for one in read[1:]):
        return limited(best.reading, CONTRADICTED_MOST)
    return best.reading


def _overlap(one: Face, other: Face) -> bool:
    """Return whether the middle of the smaller face lies in the larger one."""
    small, large = sorted((one, other), key=lambda face: face.size_px)
    return float(np.linalg.norm(np.linalg.solve(large.rim, small.middle - large.middle))) < 1.0


def _told(reading: PatchReading) -> str:
    at: SeenFace | None = reading.face
    where = "" if at is None else f" at pixel {at.middle[0]:.0f}, {at.middle[1]:.0f}"
    return f"a pointer{where} that shows {reading.value:.4g}"


def _several(told: Sequence[str]) -> str:
    return f"there are {len(told)} instruments in the picture: {', '.join(told)}. Crop it to the one that is meant"


def _without(faces: Sequence[Face], image: Image) -> Image:
    """Return the picture with faces painted over."""
    rest: NDArray[np.uint8] = image.copy()
    for face in faces:
        turns = np.linspace(0, 2 * np.pi, 60)
        rim = face.middle + 1.05 * (face.rim @ np.array([np.sin(turns), np.cos(turns)])).T
        inside = np.zeros(image.shape[:2], np.uint8)
        cv2.fillPoly(inside, [np.rint(rim).astype(np.int32)], 1)
        if inside.any():
            rest[inside > 0] = np.uint8(np.median(image[inside > 0]))
    return rest
