"""Reader of one dial that fills a photograph of a meter or gauge; nothing is taught but the ends of its scale.

The pointer may differ from the face in colour rather than in brightness, so it is searched for in several channels of
the picture, and the clearest one is used.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from hal.panel import Scale
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.patch import Patch
from perception.vision.photographs.dial_outline import SIDE_PX, dial_circle
from perception.vision.photographs.drop import find_drop, with_halo
from perception.vision.photographs.scale_ends import scale_ends
from perception.vision.reading import ANSWER_AT, PatchReading, answer_at, gated, limited, refused
from perception.vision.status.gauge import RIVAL, SIGMA_RAD, pointer_confidence, status_of_pointer
from perception.vision.status.pointer import PointerFit, PointerSearch, find_pointer, unroll, wrapped

NUMERALS_FROM, TIP_AT = 0.45, 0.72  # shares of the radius: beyond any round hub, and within every pointer
LEAST_CONNECTED = 0.7  # share of the way to the hub; a pointer comes from the hub, unlike glare or a numeral
SAME_RAD = np.deg2rad(6.0)  # pointers in different channels with a smaller difference are the same
COLOUR_OFF_RAD = np.deg2rad(
    14.0
)  # JPEG stores colours in blocks of 16 px, which may shift a pointer's direction by so much
SHOWN_WELL = 0.5  # confidence from which the direction in lightness is used
SURE, CONTRADICTED = 0.8, 0.6  # confidence of a certain needle, and of a drop that contradicts it
RIVALLED = 0.8  # factor on the confidence of an uncertain needle if a drop may point elsewhere
OTHER_RAD = np.deg2rad(35.0)  # largest angle at which one side of a drop may be taken for a needle
CLEARER_BY = 0.5  # than the best pointer elsewhere, in units of `_clearness`, for a confidence of one half
BRIGHT_FACE = 205  # gray level of a face on which saturated parts need not be glare
PIVOT_OFF = 0.08  # of the radius; in an oblique view the outline is not centred on the pivot
LEAST_COLOUR = 5.0  # contrast in units of Lab; a smaller one may be noise of the camera or of JPEG
SCALE_END_RAD = np.deg2rad(135.0)  # almost all round gauges use three quarters of a turn
USUAL_RAD = np.deg2rad(10.0)  # ticks that end so near to that mean it, with one tick more or less
# A scale with the usual span whose middle is off by more than TURNED_RAD is rotated as a whole.
SAME_SPAN_RAD, TURNED_RAD = np.deg2rad([5.0, 3.0])
# If the middle of another span is farther from straight up, the ticks at one end are not visible.
LOPSIDED_RAD = np.deg2rad(10.0)
BY_TICKS = 0.75  # confidence, because an end may be off by one tick


def read_dial(
    image: NDArray[Any], *, minimum: float, maximum: float, circular: bool, ends_rad: tuple[float, float] | None = None,
    least_confidence: float = ANSWER_AT,
) -> PatchReading:  # fmt: skip
    """Read the dial that fills the picture.

    Args:
        image: gray or RGB uint8, cropped to the dial.
        minimum, maximum: ends of the scale.
        circular: whether the scale is a full turn that begins straight up.
        ends_rad: pointer angles at minimum and maximum of a scale that is not circular. If None, they are the ends of
        the
            ticks, or three quarters of a turn if these are not found.
        least_confidence: as of `inspection.inspect`.

    Raises:
        InvalidRequest, NotObservable: bad image.
    """
    picture, circle = _at_reading_size(image)
    found = _pointer(picture, *circle)
    if found is None:
        return refused("no pointer stands out on the dial: come closer or add light")
    fit, most = found
    if circular:
        value = minimum + (fit.angle_rad % (2 * np.pi)) / (2 * np.pi) * (maximum - minimum)
        sigma = fit.sigma_rad / (2 * np.pi) * (maximum - minimum)
        status = PatchReading(value=float(value), uncertainty=float(sigma), confidence=_confidence(fit))
    else:
        (low, high), most_of_ends = (ends_rad, 1.0) if ends_rad else _ends(as_gray(picture), *circle)
        most = min(most, most_of_ends)
        scale = Scale(minimum=minimum, maximum=maximum, unit="", at_min=low, at_max=high)
        status = status_of_pointer(fit, scale, 1.0)
    return answer_at(gated(limited(status, most)), least_confidence)


def _at_reading_size(image: NDArray[Any]) -> tuple[Image, tuple[float, float, float]]:
    """Return the picture with its longer side scaled to `SIDE_PX`, and the dial in it: u, v and radius."""
    scale = SIDE_PX / max(image.shape[:2])
    interpolation = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    picture = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=interpolation), np.uint8)
    return picture, dial_circle(as_gray(image), scale)


def _ends(gray: Image, u: float, v: float, radius: float) -> tuple[tuple[float, float], float]:
    """Return the pointer angles at minimum and maximum, and the largest confidence that they justify."""
    usual = (-SCALE_END_RAD, SCALE_END_RAD)
    by_ticks = scale_ends(gray, u, v, radius)
    if by_ticks is None:
        return usual, 1.0
    wider_rad, turned_rad = by_ticks[1] - by_ticks[0] - 2 * SCALE_END_RAD, 0.5 * (by_ticks[0] + by_ticks[1])
    if abs(wider_rad) < SAME_SPAN_RAD and abs(turned_rad) > TURNED_RAD:
        return (usual[0] + turned_rad, usual[1] + turned_rad), BY_TICKS
    if 0.5 * abs(wider_rad) + abs(turned_rad) < USUAL_RAD:
        return usual, 1.0
    return (usual if abs(turned_rad) > LOPSIDED_RAD else by_ticks), BY_TICKS


def _pointer(picture: Image, u: float, v: float, radius: float) -> tuple[PointerFit, float] | None:
    """Return the pointer and the largest confidence that it justifies; None if none stands out."""
    drop, by_sides = find_drop(picture, u, v, radius)
    if drop is not None:
        return drop.fit, drop.most
    in_gray, in_colour = _lines(picture, u, v, radius)
    fit, most = None, 0.0
    if in_gray or in_colour:
        fit, rival = _believed(in_gray, in_colour)
        most = min(_confidence(fit), _agreement(fit, rival))
    elsewhere = by_sides is not None and (fit is None or _apart(fit, by_sides.fit) > OTHER_RAD)
    if by_sides is not None and elsewhere and by_sides.most > min(most, SURE):
        return by_sides.fit, by_sides.most if most < SURE else CONTRADICTED
    if elsewhere and most < SURE:
        most *= RIVALLED
    return None if fit is None else (fit, most)


def _lines(picture: Image, u: float, v: float, radius: float) -> tuple[list[PointerFit], list[PointerFit]]:
    """Return needle candidates in lightness, and those in the other channels, dark and bright."""
    gray = as_gray(picture)
    glare = _glare(gray, u, v, radius)
    fits: list[list[PointerFit]] = []
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    for channel, least in _channels(picture, gray, np.hypot(x - u, y - v) < radius):
        patch = _patch(channel, u, v)
        fits.append([])
        for dark in (True, False):
            search = PointerSearch(
                pivot_m=(0.0, 0.0), inner_m=NUMERALS_FROM * radius, outer_m=TIP_AT * radius,
                fine_m=(0.35 * radius, 0.78 * radius), width_rad=float(np.deg2rad(50.0)), quantile=0.4, dark=dark,
                pivot_sigma_px=0.02 * radius,
            )  # fmt: skip
            fit = find_pointer(patch, search, cover=glare)
            if fit is None or fit.contrast < least:
                continue
            if _reaches_hub(patch, fit.angle_rad, radius) >= LEAST_CONNECTED:
                fits[-1].append(fit)
    return fits[0], [fit for of_channel in fits[1:] for fit in of_channel]


def _believed(in_gray: list[PointerFit], in_colour: list[PointerFit]) -> tuple[PointerFit, PointerFit | None]:
    """Return the pointer to be read, and the clearest one in another direction.

    Lightness is sharper than colour, so its direction is used if it shows the clearest pointer well.
    """
    fits = in_gray + in_colour
    best, same_rad = max(fits, key=_clearness), SAME_RAD
    well = [fit for fit in in_gray if _apart(fit, best) < COLOUR_OFF_RAD and _confidence(fit) > SHOWN_WELL]
    if well:
        best, same_rad = max(well, key=_clearness), COLOUR_OFF_RAD
    others = [fit for fit in fits if _apart(fit, best) > same_rad]
    return best, max(others, key=_clearness, default=None)


def _agreement(best: PointerFit, rival: PointerFit | None) -> float:
    """Return the largest confidence given the other channels: too low for an answer if a clear one points elsewhere."""
    if rival is None:
        return 1.0
    return float(1.0 / (1.0 + np.exp(-(_clearness(best) - _clearness(rival) - CLEARER_BY) / 0.3)))


def _apart(one: PointerFit, other: PointerFit) -> float:
    """Return the angle between two pointers."""
    return float(abs(wrapped(np.array(one.angle_rad - other.angle_rad))))


def _confidence(fit: PointerFit) -> float:
    """Return the confidence of a needle."""
    return pointer_confidence(fit, 1.0, rival=RIVAL, sigma_rad=SIGMA_RAD)


def _clearness(fit: PointerFit) -> float:
    """Return how clearly a needle stands out; for comparison with other needles."""
    return float(np.log(fit.strength) + 3.0 * (1.0 - fit.rival_ratio) + 2.0 * fit.supported)


def _glare(gray: Image, u: float, v: float, radius: float) -> NDArray[np.bool_] | None:
    """Return a mask (H, W) of saturated spots, with halos, that do not come from the dial's middle as a pointer does.

    None if there are none, or if the face is so bright that a saturated part of it need not be glare.
    """
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    away = np.hypot(x - u, y - v)
    face = float(np.median(gray[away < radius]))
    if face > BRIGHT_FACE:
        return None
    count, labels, stats, _ = cv2.connectedComponentsWithStats((gray >= WHITE_LEVEL).astype(np.uint8))
    middle = np.unique(labels[away < 0.2 * radius])
    least, most = (share * np.pi * radius**2 for share in (0.002, 0.15))
    spots = [k for k in range(1, count) if k not in middle and least < stats[k, cv2.CC_STAT_AREA] < most]
    if not spots:
        return None
    return with_halo(np.isin(labels, spots), radius)


def _reaches_hub(patch: Patch, angle_rad: float, radius: float) -> float:
    """Return the share of the way from hub to numerals that resembles the outer pointer rather than the face."""
    turn = np.linspace(-np.pi, np.pi, 180)
    outer = np.linspace(NUMERALS_FROM, TIP_AT, 12) * radius
    inner = np.linspace(0.15, NUMERALS_FROM, 12) * radius
    face = np.median(unroll(patch, (0.0, 0.0), outer, turn), axis=1)
    beside = angle_rad + np.deg2rad(np.array([-2.0, 0.0, 2.0]))
    pointer = unroll(patch, (0.0, 0.0), outer, beside).mean(axis=1)
    contrast = float(np.median(pointer - face))
    if contrast == 0:
        return 0.0
    # The pivot may be off the dial's middle, so a strip of that width is searched.
    off = np.linspace(-PIVOT_OFF, PIVOT_OFF, 9) * radius
    x = inner[:, None] * np.sin(angle_rad) + off * np.cos(angle_rad)
    y = inner[:, None] * np.cos(angle_rad) - off * np.sin(angle_rad)
    way = (patch.sample(x, y) - float(np.median(face))) / contrast
    return float((way.max(axis=1) > 0.5).mean())


def _channels(image: Image, gray: Image, disc: NDArray[np.bool_]) -> list[tuple[Image, float]]:
    """Return pictures in which a pointer may stand out, each with the least contrast that counts there."""
    channels = [(gray, 0.0)]
    if image.ndim == 3:
        lab = cv2.cvtColor(np.ascontiguousarray(image[:, :, :3]), cv2.COLOR_RGB2LAB).astype(np.float32)
        for k in (1, 2):
            part = cv2.GaussianBlur(lab[:, :, k], (0, 0), 1.0)
            low, high = np.percentile(part[disc], [2, 99.5])
            if high - low >= 12.0:
                gain = 220.0 / (high - low)
                coded = np.clip((part - low) * gain + 10, 0, 255).astype(np.uint8)
                channels.append((coded, LEAST_COLOUR * gain))
    return channels


def _patch(channel: Image, u: float, v: float) -> Patch:
    """Return a channel as a patch with the dial's middle as origin and pixels as unit."""
    return Patch(
        gray=channel, colour=None, inside=np.ones(channel.shape, bool), px_per_m=1.0, image_px_per_m=1.0,
        origin_px=np.array([u, v]), parallax_px_per_m=np.zeros(2), growth_per_m=0.0, plane_z_m=0.0,
    )  # fmt: skip
