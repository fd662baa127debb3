"""The readers of printed characters are taught by gradients that are right, and know characters that they have not seen."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.vision_numerals import ALPHABETS, FONTS, drawn, pictures, right, taught
from benchmarks.vision_numerals import _gradients as gradients
from perception.vision.photographs.printed_digits import OTHER, Network, cell_of, shipped_network


def test_the_gradients_are_those_of_finite_differences() -> None:
    random = np.random.default_rng(3)
    shapes = {"A": (320, 6), "a": (6,), "B": (6, 11), "b": (11,)}
    weights = {name: random.normal(0.0, 0.3, shape) for name, shape in shapes.items()}
    x, wanted = random.uniform(0.0, 1.0, (7, 320)), np.eye(11)[random.integers(0, 11, 7)]

    def loss(**changed: np.ndarray) -> float:
        network = Network(**{**weights, **changed})  # type: ignore[arg-type]  # double precision: finite differences need it
        found = network.probabilities(x.astype(float).reshape(7, 20, 16))  # type: ignore[arg-type]  # the same
        return -float(np.log((found.astype(float) * wanted).sum(axis=1)).mean())

    slopes, _ = gradients(Network(**weights), x, wanted)  # type: ignore[arg-type]  # the same
    for (name, values), slope in zip(weights.items(), slopes, strict=True):
        at = tuple(int(random.integers(0, n)) for n in values.shape)
        step = np.zeros_like(values)
        step[at] = 1e-2
        numeric = (loss(**{name: values + step}) - loss(**{name: values - step})) / 2e-2
        assert abs(numeric - slope[at]) < 2e-3


@pytest.mark.parametrize(("name", "least"), [("digits", 0.8), ("letters", 0.7)])
def test_a_short_teaching_reads_most_characters(name: str, least: float) -> None:
    said: list[str] = []
    network = taught(*pictures(ALPHABETS[name], FONTS[:2], 3000, 1), said.append)
    assert len(said) == 14
    share = float(right(network, *pictures(ALPHABETS[name], FONTS[:2], 400, 2)).split()[3].rstrip(","))
    assert share > least


def test_the_shipped_network_reads_clean_digits_of_every_font_and_no_letters() -> None:
    def kinds(text: str) -> list[int]:
        cells = []
        for font in FONTS:
            for character in text:
                large = drawn(font, character).astype(np.float32)
                v, u = (np.flatnonzero(large.any(axis=axis)) for axis in (1, 0))
                cells.append(cell_of(large[v[0] : v[-1] + 1, u[0] : u[-1] + 1]))
        return [int(kind) for kind in shipped_network().probabilities(np.array(cells)).argmax(axis=1)]

    found = np.array(kinds("0123456789")).reshape(len(FONTS), 10)
    assert np.mean(found == np.arange(10)) > 0.98
    assert np.mean(np.array(kinds("AHKMRTXY")) == OTHER) > 0.9
