"""Recognises single printed characters by a small network, which `benchmarks.vision_numerals` has taught on drawn ones."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

FILE = Path(__file__).with_name("printed_digits.npz")
CELL = (20, 16)  # rows and columns that the network sees
TALL, WIDE = 18, 14  # of a character in it
OTHER = 10  # the class of whatever is no digit

Float32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Network:
    """Two layers: `softmax(relu(x A + a) B + b)` of the pixels x of a cell."""

    A: Float32
    a: Float32
    B: Float32
    b: Float32

    @staticmethod
    def load(file: Path = FILE) -> Network:
        """Return the network in a file."""
        with np.load(file) as stored:
            return Network(**{name: stored[name].astype(np.float32) for name in ("A", "a", "B", "b")})

    def probabilities(self, cells: Float32) -> Float32:
        """Return (N, classes) probabilities of what the cells (N, 20, 16), from `cell_of`, show.

        Of digits the classes are 0 to 9, and whatever is no digit.
        """
        hidden = np.maximum(cells.reshape(len(cells), -1) @ self.A + self.a, 0.0)
        level = hidden @ self.B + self.b
        raised = np.exp(level - level.max(axis=1, keepdims=True))
        return np.asarray(raised / raised.sum(axis=1, keepdims=True), np.float32)


@cache
def shipped_network() -> Network:
    """Return the network for digits that the package carries."""
    return Network.load()


def cell_of(ink: Float32) -> Float32:
    """Return a character (H, W), bright on dark and cut out closely, as a cell with values from 0 to 1."""
    height, width = ink.shape
    tall, wide = TALL, max(1, min(WIDE, round(width * TALL / height)))
    shrinks = height > tall
    resized = cv2.resize(ink, (wide, tall), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    character = np.asarray(resized, np.float32)
    cell = np.zeros(CELL, np.float32)
    top, left = (CELL[0] - tall) // 2, (CELL[1] - wide) // 2
    cell[top : top + tall, left : left + wide] = character / max(float(np.quantile(character, 0.95)), 1.0)
    return np.asarray(np.clip(cell, 0.0, 1.0), np.float32)
