"""Search for the pointer, or the pointers, of one dial that fills a photograph.

A pointer may differ from the face in colour rather than in brightness, so it is searched for in several channels of the
picture, and the clearest one is used.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from hal.arrays import Image
from perception.vision.image import WHITE_LEVEL, as_gray
from perception.vision.patch import Patch
from perception.vision.photographs.drop import find_drop, with_halo
from perception.vision.photographs.red_pointer import find_red_pointer, length_of, patch_about, redness, without
from perception.vision.status.gauge import RIVAL, SIGMA_RAD, pointer_confidence
from perception.vision.status.pointer import PointerFit, PointerSearch, find_pointer, unroll, wrapped

Pointer = Literal["black", "red"]

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
TWO_RAD = np.deg2rad(12.0)  # two pointers that are nearer are not told apart from one with its shadow
SECOND = 0.5  # confidence from which a pointer beside a red one counts
ONE_OF_TWO = 0.75  # largest confidence where a weaker second pointer cannot be excluded


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
        return (
            [_hand(picture, circle, *found)] if found else "no pointer stands out on the dial: come closer or add light"
        )
    red_hand = _hand(picture, circle, in_red, confidence_of(in_red), red)
    rest = without(picture, red, in_red, *circle)
    found = _pointer(rest, *circle)
    apart = found is not None and _apart(found[0], in_red) > TWO_RAD
    if found is not None and apart and min(found[1], confidence_of(found[0])) >= SECOND:
        black = _hand(rest, circle, *found)
        return [red_hand, black] if asked == "red" else [black, red_hand]
    if asked == "black":
        return "no pointer but a red one stands out on the dial: come closer or add light"
    if asked == "red":
        return [red_hand]
    alone = _pointer(picture, *circle)
    if alone is None:
        return [red_hand]
    sure = _apart(alone[0], in_red) < SAME_RAD and not (found is not None and apart and found[1] > 1.0 - SURE)
    return [_hand(picture, circle, alone[0], alone[1] if sure else min(alone[1], ONE_OF_TWO), red)]


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
    own = gray[(across < 1.0) & (along > 0.25 * circle[2]) & (along < 0.55 * circle[2])]
    is_dark = own.size == 0 or float(np.median(own)) <= face
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
        fit, rival = _believed(in_gray, in_colour)
        most = min(confidence_of(fit), _agreement(fit, rival))
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
    for channel, least in _channels(picture, gray, disc):
        patch = patch_about(channel, u, v)
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
    well = [fit for fit in in_gray if _apart(fit, best) < COLOUR_OFF_RAD and confidence_of(fit) > SHOWN_WELL]
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
