"""Teaches the readers of printed characters: `python -m benchmarks.vision_numerals digits|letters [FILE]`.

Draws characters of the fonts that matplotlib and OpenCV carry as a camera sees them, teaches a network of two layers to
tell the digits from each other and from anything else, or the letters of units, prints the shares that are right on
drawings of fonts left out of a first teaching and of all fonts, and writes the network of all fonts. It takes minutes on
one processor.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from matplotlib import get_data_path
from numpy.typing import NDArray
from PIL import Image as Pillow
from PIL import ImageDraw, ImageFont

from hal.arrays import Image
from perception.vision.photographs import printed_digits, units
from perception.vision.photographs.printed_digits import CELL, Float32, Network, cell_of

FONTS = (
    "DejaVuSans", "DejaVuSans-Bold", "DejaVuSans-Oblique", "DejaVuSansMono", "DejaVuSansMono-Bold", "DejaVuSerif",
    "DejaVuSerif-Bold", "STIXGeneral", "STIXGeneralBol", "STIXGeneralItalic", "cmr10", "cmss10", "cmb10",
    "cmtt10",
)  # fmt: skip
HERSHEY = (cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX, cv2.FONT_HERSHEY_COMPLEX, cv2.FONT_HERSHEY_TRIPLEX)
LEFT_OUT = ("DejaVuSans-Bold", "cmss10", "STIXGeneral", cv2.FONT_HERSHEY_DUPLEX)
DRAWN_PX = 96
OTHER_SHARE, MARK_SHARE = 0.14, 0.08
PICTURES, BATCH, ROUNDS, HIDDEN = 160_000, 256, 14, 160
RATE, DECAY = 2e-3, 1e-5
SEED = 24

Font = str | int


@dataclass(frozen=True, slots=True, kw_only=True)
class Alphabet:
    """What a network tells apart: each class is drawn as any of its characters; `others` are no class, and look like none."""

    file: Path
    classes: tuple[str, ...]
    others: str


ALPHABETS = {
    "digits": Alphabet(
        file=printed_digits.FILE,
        classes=tuple("0123456789"),
        others="ABCDEFGHJKMNPQRSTUVWXYZabcdefghkmnprstuvwxyz%/()&",
    ),
    "letters": Alphabet(file=units.FILE, classes=units.GLYPHS, others="345678DEFGHJLNOQTUVWXYZdehjoqtuvwxyz%()&"),
}


@cache
def drawn(font: Font, character: str) -> Image:
    """Return a large drawing of a character, bright on dark."""
    canvas = np.zeros((2 * DRAWN_PX, 2 * DRAWN_PX), np.uint8)
    if isinstance(font, int):
        cv2.putText(canvas, character, (40, 140), font, 3.6, 255, 9, cv2.LINE_AA)
        return canvas
    picture = Pillow.fromarray(canvas)
    file = Path(get_data_path()) / "fonts" / "ttf" / f"{font}.ttf"
    ImageDraw.Draw(picture).text((50, 20), character, fill=255, font=ImageFont.truetype(str(file), DRAWN_PX))
    return np.asarray(picture, np.uint8)


def mark(random: np.random.Generator) -> Image:
    """Return a large drawing of what is no character: a slanted or level bar, an arc, a disc, or parts of two digits."""
    canvas, middle = np.zeros((2 * DRAWN_PX, 2 * DRAWN_PX), np.uint8), np.full(2, float(DRAWN_PX))
    match int(random.integers(4)):
        case 0:
            turn = random.uniform(0.3, np.pi - 0.3)  # from upright
            way = random.uniform(20.0, 45.0) * np.array([np.sin(turn), np.cos(turn)])
            first, last = (tuple(map(int, middle + sign * way)) for sign in (-1, 1))
            cv2.line(canvas, first, last, 255, int(random.integers(5, 16)), cv2.LINE_AA)
        case 1:
            axes, begin = (int(random.integers(20, 60)), int(random.integers(20, 60))), float(random.uniform(0, 360))
            end = begin + float(random.uniform(40, 120))
            cv2.ellipse(
                canvas, (DRAWN_PX, DRAWN_PX), axes, 0.0, begin, end, 255, int(random.integers(5, 14)), cv2.LINE_AA
            )
        case 2:
            cv2.circle(canvas, (DRAWN_PX, DRAWN_PX), int(random.integers(12, 40)), 255, -1, cv2.LINE_AA)
        case _:
            a, b = (drawn(FONTS[int(random.integers(len(FONTS)))], str(random.integers(10))) for _ in range(2))
            canvas = np.maximum(np.roll(a, -22, axis=1), np.roll(b, 22, axis=1))
            canvas[:, : DRAWN_PX - 45], canvas[:, DRAWN_PX + 40 :] = 0, 0
    return canvas


def seen(large: Image, random: np.random.Generator) -> Float32 | None:
    """Return a drawn character as a camera sees it, cut out at its ink; None if nothing of it is left."""
    thick = int(random.integers(-1, 6))
    kernel = np.ones((abs(thick) + 1, abs(thick) + 1), np.uint8)
    shaped = cv2.dilate(large, kernel) if thick > 0 else cv2.erode(large, kernel)
    tall = float(np.exp(random.uniform(np.log(7.0), np.log(34.0))))
    scale = tall / (0.72 * DRAWN_PX)
    turn, lean, narrowed = random.normal(0.0, 0.08), random.normal(0.0, 0.08), random.uniform(0.72, 1.2)
    turned = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    linear = scale * turned @ np.array([[narrowed, lean], [0.0, 1.0]])
    side = max(24, round(1.9 * tall))
    middle = np.array(large.shape) / 2
    move = np.column_stack([linear, side / 2 + random.uniform(-0.5, 0.5, 2) - linear @ middle])
    smooth = cv2.GaussianBlur(shaped, (0, 0), max(0.3, 0.4 / scale))
    small = cv2.warpAffine(smooth, move, (side, side), flags=cv2.INTER_LINEAR)
    small = cv2.GaussianBlur(small, (0, 0), float(random.uniform(0.2, 0.3 + 0.04 * tall)))
    noisy = small + random.normal(0.0, random.uniform(0.0, 14.0), small.shape)
    return _cut(np.asarray(np.clip(noisy, 0, 255), np.float32))


def _cut(ink: Float32) -> Float32 | None:
    """Return the connected ink nearest to the middle of the picture, with the box around it."""
    count, _, boxes, middles = cv2.connectedComponentsWithStats(
        (ink > 0.42 * ink.max()).astype(np.uint8), connectivity=8
    )
    if count < 2:
        return None
    away = np.hypot(*(middles[1:] - np.array(ink.shape)[::-1] / 2).T) / np.sqrt(boxes[1:, cv2.CC_STAT_AREA])
    x, y, w, h, _ = boxes[1 + int(away.argmin())]
    return None if h < 5 else np.asarray(ink[y : y + h, x : x + w], np.float32)


def pictures(alphabet: Alphabet, fonts: Sequence[Font], count: int, seed: int) -> tuple[Float32, NDArray[np.int64]]:
    """Return (N, 20, 16) cells of random characters, and the class of each."""
    other = len(alphabet.classes)
    random = np.random.default_rng(seed)
    cells, classes = list[Float32](), list[int]()
    while len(cells) < count:
        font = fonts[int(random.integers(len(fonts)))]
        share = random.random()
        kind = other if share < OTHER_SHARE + MARK_SHARE else int(random.integers(other))
        characters = alphabet.others if kind == other else alphabet.classes[kind]
        character = characters[int(random.integers(len(characters)))] if len(characters) > 1 else characters
        ink = seen(mark(random) if share < MARK_SHARE else drawn(font, character), random)
        if ink is not None:
            cells.append(cell_of(ink))
            classes.append(kind)
    return np.array(cells, np.float32), np.array(classes)


def taught(cells: Float32, classes: NDArray[np.int64], progress: Callable[[str], None]) -> Network:
    """Return a network taught by Adam on the cross-entropy of the classes (Kingma and Ba, 2015)."""
    random = np.random.default_rng(SEED)
    count = int(classes.max()) + 1
    x, wanted = cells.reshape(len(cells), -1), np.eye(count, dtype=np.float32)[classes]
    inputs = CELL[0] * CELL[1]
    weights = [
        random.normal(0.0, np.sqrt(2.0 / inputs), (inputs, HIDDEN)).astype(np.float32), np.zeros(HIDDEN, np.float32),
        random.normal(0.0, np.sqrt(2.0 / HIDDEN), (HIDDEN, count)).astype(np.float32), np.zeros(count, np.float32),
    ]  # fmt: skip
    mean, square = [np.zeros_like(w) for w in weights], [np.zeros_like(w) for w in weights]
    steps, total = 0, ROUNDS * (len(x) // BATCH)
    for turn in range(ROUNDS):
        order, loss = random.permutation(len(x)), 0.0
        for k in range(0, len(order) - BATCH + 1, BATCH):
            rows = order[k : k + BATCH]
            network = Network(A=weights[0], a=weights[1], B=weights[2], b=weights[3])
            gradients, missed = _gradients(network, x[rows], wanted[rows])
            loss, steps = loss + missed, steps + 1
            rate = RATE * (1.0 - steps / total) * np.sqrt(1 - 0.999**steps) / (1 - 0.9**steps)
            for layer, gradient in enumerate(gradients):
                mean[layer] += 0.1 * (gradient - mean[layer])
                square[layer] += 0.001 * (gradient * gradient - square[layer])
                weights[layer] -= rate * mean[layer] / (np.sqrt(square[layer]) + 1e-8) + DECAY * weights[layer]
        progress(f"  round {turn + 1} of {ROUNDS}: mean loss {loss * BATCH / len(x):.4f}")
    return Network(A=weights[0], a=weights[1], B=weights[2], b=weights[3])


def _gradients(network: Network, x: Float32, wanted: Float32) -> tuple[list[Float32], float]:
    """Return the gradients of the mean cross-entropy for the four weights, and the cross-entropy."""
    hidden = np.maximum(x @ network.A + network.a, 0.0)
    found = network.probabilities(x)
    off = (found - wanted) / len(x)
    back = (off @ network.B.T) * (hidden > 0.0)
    loss = -float(np.log(np.maximum((found * wanted).sum(axis=1), 1e-12)).mean())
    return [x.T @ back, back.sum(axis=0), hidden.T @ off, off.sum(axis=0)], loss


def right(network: Network, cells: Float32, classes: NDArray[np.int64]) -> str:
    """Return the shares of characters of the classes, and of others, that are recognised."""
    found, other = network.probabilities(cells).argmax(axis=1), len(network.b) - 1
    of_class = classes != other
    return (
        f"of the classes {np.mean(found[of_class] == classes[of_class]):.4f}, "
        f"others {np.mean(found[~of_class] == other):.4f}, of {len(cells)}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Teach twice, print the shares, and write the network."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("alphabet", choices=ALPHABETS)
    parser.add_argument("file", type=Path, nargs="?", default=None)
    given = parser.parse_args(arguments)
    alphabet, every = ALPHABETS[given.alphabet], (*FONTS, *HERSHEY)
    file: Path = given.file or alphabet.file
    kept = [font for font in every if font not in LEFT_OUT]
    print(f"drawing {PICTURES} characters", flush=True)
    first = taught(*pictures(alphabet, kept, PICTURES // 2, SEED), print)
    print("fonts left out:", right(first, *pictures(alphabet, LEFT_OUT, 8000, SEED + 1)), flush=True)
    last = taught(*pictures(alphabet, every, PICTURES, SEED + 2), print)
    print("all fonts:", right(last, *pictures(alphabet, every, 8000, SEED + 3)))
    np.savez_compressed(file, **{name: getattr(last, name).astype(np.float16) for name in ("A", "a", "B", "b")})
    print(f"wrote {file.name}, {file.stat().st_size / 1e3:.0f} kB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
