"""Search for the pointer, or the pointers, of one dial that fills a photograph.

A pointer may differ from the face in colour rather than in brightness, so it is searched for in several channels of the
picture, and the clearest one is used.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array, Image
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.patch import Patch
from perception.vision.photographs.drop import find_drop, with_halo
from perception.vision.photographs.red_pointer import find_red_pointer, is_red, length_of, patch_about, redness, without
from perception.vision.status.gauge import RIVAL, SIGMA_RAD, pointer_confidence
from perception.vision.status.pointer import PointerFit, PointerSearch, find_pointer, wrapped

Pointer = Literal["black", "red"]

NUMERALS_FROM, TIP_AT = 0.45, 0.72  # shares of the radius: beyond any round hub, and within every pointer
LEAST_CONNECTED = 0.7  # share of the way to the hub; a pointer comes from the hub, unlike glare or a numeral
SAME_RAD = np.deg2rad(6.0)  # pointers in different channels with a smaller difference are the same
COLOUR_OFF_RAD = np.deg2rad(
    14.0
)  # JPEG stores colours in blocks of 16 px, which may shift a pointer's direction by so much
ONLY_IN_COLOUR = 0.75  # largest confidence of a pointer that lightness does not show in the same direction
SHOWN_WELL = 0.5  # confidence from which the direction in lightness is used
SURE, CONTRADICTED = 0.8, 0.6  # confidence of a certain needle, and of a drop that contradicts it
RIVALLED = 0.8  # factor on the confidence of an uncertain needle if a drop may point elsewhere
OTHER_RAD = np.deg2rad(35.0)  # largest angle at which one side of a drop may be taken for a needle
CLEARER_BY = 0.5  # than the best pointer elsewhere, in units of `_clearness`, for a confidence of one half
BRIGHT_FACE = 205  # gray level of a face on which saturated parts need not be glare
# Shares of the radius across a pointer: where it may be, because the outline is not centred on the pivot in an oblique
# view, and the face on both sides.
STRIP, BESIDE = np.linspace(-0.08, 0.08, 9), np.array([-0.2, -0.16, -0.12, 0.12, 0.16, 0.2])
HUB_TO = 0.15  # of the radius
LEAST_RIVAL, RIVAL_CONNECTED = 0.4, 0.5  # a rival with a smaller score does no harm; one that is less connected is none
NUMERAL_RAD = np.deg2rad(6.0)  # half width of the sector in which a numeral is covered
MOST_COVERED = 4  # directions
LEAST_COLOUR = 5.0  # contrast in units of Lab; a smaller one may be noise of the camera or of JPEG
TIMES_FACE = 0.7  # least contrast of a bright pointer, relative to the face; reflections on a bright face have less
TWO_RAD = np.deg2rad(12.0)  # two pointers that are nearer are not told apart from one with its shadow
SECOND = 0.5  # confidence from which a pointer beside a red one counts


@dataclass(frozen=True, slots=True, kw_only=True)
class Hand:
    """A pointer on a dial: its fit, the largest confidence that it justifies, colour, and length (share of the radius)."""

    fit: PointerFit
    most: float
    colour: str
    length: float


def find_hands(picture: Image, circle: tuple[float, float, float], asked: Pointer | None) -> list[Hand] | str:
    """Return the pointers of a dial, the asked one first, or the reason why the asked one cannot be found.

    Args:
        picture: (H, W) gray or (H, W, 3) RGB uint8.
        circle: u, v and radius of the dial in it, px.
        asked: `black` is the pointer that is not red; None: whichever there is.
    """
    if picture.ndim == 2 and asked == "red":
        return "a gray picture does not show which pointer is red: take it in colour"
    red = redness(picture, *circle) if picture.ndim == 3 else None
    in_red = None if red is None else find_red_pointer(red, *circle)
    if red is None or in_red is None:
        if asked == "red":
            return "no red pointer stands out on the dial: come closer or add light"
        found = _pointer(picture, *circle)
        if found is None:
            return "no pointer stands out on the dial: come closer or add light"
        if red is None or not is_red(picture, found[0], *circle):
            return [_hand(picture, circle, *found)]
        in_red = found[0]
    red_hand = _hand(picture, circle, in_red, confidence_of(in_red), red)
    rest = without(picture, red, in_red, *circle)
    other = _other(rest, in_red, *circle)
    if other is not None and not is_red(picture, other, *circle) and confidence_of(other) >= SECOND:
        black = _hand(rest, circle, other, confidence_of(other))
        return [red_hand, black] if asked == "red" else [black, red_hand]
    if asked == "black":
        return "no pointer but a red one stands out on the dial: come closer or add light"
    if asked == "red":
        return [red_hand]
    alone = _pointer(picture, *circle)
    if alone is None:
        return [red_hand]
    return [_hand(picture, circle, *alone, red)]


def _other(rest: Image, red: PointerFit, u: float, v: float, radius: float) -> PointerFit | None:
    """Return the line beside a red pointer, in the lightness of the picture without that; None if there is none.

    What lies on the red pointer's own axis may be its other end.
    """
    fits, _ = _lines(as_gray(rest), u, v, radius)
    best = max(fits, key=_clearness, default=None)
    if best is None or min(_apart(best, red), _apart(best, replace(red, angle_rad=red.angle_rad + np.pi))) < TWO_RAD:
        return None
    return best


def _hand(
    picture: Image, circle: tuple[float, float, float], fit: PointerFit, most: float, red: NDArray[np.float32] | None = None
) -> Hand:  # fmt: skip
    """Return a pointer with its colour and length; `red`: the redness in which it was found."""
    if red is not None:
        return Hand(fit=fit, most=most, colour="red", length=length_of(_coded(10 * red), fit.angle_rad, *circle))
    gray = as_gray(picture).astype(np.float32)
    y, x = np.mgrid[: gray.shape[0], : gray.shape[1]]
    right, up = x - circle[0], circle[1] - y
    face = float(np.median(gray[np.hypot(right, up) < 0.8 * circle[2]]))
    along = right * np.sin(fit.angle_rad) + up * np.cos(fit.angle_rad)
    across = np.abs(right * np.cos(fit.angle_rad) - up * np.sin(fit.angle_rad))
    own = gray[(across < STRIP[-1] * circle[2]) & (along > 0.25 * circle[2]) & (along < 0.55 * circle[2])]
    low, high = np.percentile(own, [5, 95])
    is_dark = bool(face - low >= high - face)
    ink = _coded(face - gray if is_dark else gray - face)
    colour = "black" if is_dark else "white"
    return Hand(fit=fit, most=most, colour=colour, length=length_of(ink, fit.angle_rad, *circle))


def _coded(ink: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return ink as gray levels."""
    return np.asarray(np.clip(ink, 0, 255), np.uint8)


def _pointer(picture: Image, u: float, v: float, radius: float) -> tuple[PointerFit, float] | None:
    """Return the pointer and the largest confidence that it justifies; None if none stands out."""
    drop, by_sides = find_drop(picture, u, v, radius)
    if drop is not None:
        return drop.fit, drop.most
    in_gray, in_colour = _lines(picture, u, v, radius)
    fit, most = None, 0.0
    if in_gray or in_colour:
        fit, most, rival = _believed(in_gray, in_colour)
        most = min(most, confidence_of(fit), _agreement(fit, rival))
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
    disc = np.hypot(x - u, y - v) < radius
    face = float(np.median(gray[disc]))
    for channel, least in _channels(picture, gray, disc):
        patch = patch_about(channel, u, v)
        fits.append([])
        for dark in (True, False):
            fit = _from_hub(patch, radius, glare, dark=dark)
            if fit is not None and fit.contrast >= (TIMES_FACE * face if channel is gray and not dark else least):
                fits[-1].append(fit)
    return fits[0], [fit for of_channel in fits[1:] for fit in of_channel]


def _from_hub(patch: Patch, radius: float, glare: NDArray[np.bool_] | None, *, dark: bool) -> PointerFit | None:
    """Return the clearest pointer of one polarity that comes from the hub; None if none stands out.

    Numerals and words do not come from the hub. They are covered, so that they are no rivals either.
    """
    search = PointerSearch(
        pivot_m=(0.0, 0.0), inner_m=NUMERALS_FROM * radius, outer_m=TIP_AT * radius,
        fine_m=(0.35 * radius, 0.78 * radius), width_rad=float(np.deg2rad(50.0)), quantile=0.4, dark=dark,
        pivot_sigma_px=0.02 * radius,
    )  # fmt: skip
    y, x = np.mgrid[: patch.gray.shape[0], : patch.gray.shape[1]]
    turn = np.arctan2(x - patch.origin_px[0], patch.origin_px[1] - y)
    cover, connected = glare, None
    for _ in range(MOST_COVERED):
        fit = find_pointer(patch, search, cover=cover)
        if fit is None:
            break
        if _reaches_hub(patch, fit, radius) < LEAST_CONNECTED:
            other = fit.angle_rad
        else:
            connected, other = fit, fit.rival_rad
            rival = replace(fit, angle_rad=other)
            if fit.rival_ratio < LEAST_RIVAL or _reaches_hub(patch, rival, radius) > RIVAL_CONNECTED:
                break
        sector = np.abs(wrapped(turn - other)) < NUMERAL_RAD
        cover = sector if cover is None else cover | sector
    return connected


def _believed(in_gray: list[PointerFit], in_colour: list[PointerFit]) -> tuple[PointerFit, float, PointerFit | None]:
    """Return the pointer to be read, the largest confidence of its direction, and the clearest one in another direction.

    Lightness is sharper than colour, so its direction is used if it shows the clearest pointer, too; a direction that
    only colour shows is never sure.
    """
    fits = in_gray + in_colour
    best, same_rad, most = max(fits, key=_clearness), SAME_RAD, 1.0
    well = [fit for fit in in_gray if _apart(fit, best) < COLOUR_OFF_RAD and confidence_of(fit) > SHOWN_WELL]
    if well:
        best, same_rad = max(well, key=_clearness), COLOUR_OFF_RAD
    elif best not in in_gray:
        most = ONLY_IN_COLOUR
    others = [fit for fit in fits if _apart(fit, best) > same_rad]
    return best, most, max(others, key=_clearness, default=None)


def _agreement(best: PointerFit, rival: PointerFit | None) -> float:
    """Return the largest confidence given the other channels: too low for an answer if a clear one points elsewhere."""
    if rival is None:
        return 1.0
    return float(1.0 / (1.0 + np.exp(-(_clearness(best) - _clearness(rival) - CLEARER_BY) / 0.3)))


def _apart(one: PointerFit, other: PointerFit) -> float:
    """Return the angle between two pointers."""
    return float(abs(wrapped(np.array(one.angle_rad - other.angle_rad))))


def confidence_of(fit: PointerFit) -> float:
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


def _reaches_hub(patch: Patch, fit: PointerFit, radius: float) -> float:
    """Return the share of the way from hub to numerals that resembles the outer pointer rather than the face beside it.

    The pivot may be off the dial's middle, so the pointer is looked for in a strip of that width.
    """
    sin, cos, sign = np.sin(fit.angle_rad), np.cos(fit.angle_rad), -1.0 if fit.is_dark else 1.0

    def ink(first: float, last: float) -> Array:
        r = np.linspace(first, last, 12)[:, None] * radius
        strip, beside = (
            patch.sample(r * sin + off * radius * cos, r * cos - off * radius * sin) for off in (STRIP, BESIDE)
        )
        return np.asarray((sign * strip).max(axis=1) - np.median(sign * beside, axis=1))

    least = 0.5 * float(np.median(ink(NUMERALS_FROM, TIP_AT)))
    return float((ink(HUB_TO, NUMERALS_FROM) > least).mean()) if least > 0.0 else 0.0


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
