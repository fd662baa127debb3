"""Tests of certificates: the bound holds as often as it says, clusters count once, and other pictures have none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from hal.errors import ConfigError
from service.certificate.bound import by_cluster, wrong_at_most
from service.certificate.record import Case, Certificate, CertificateFile, kinds_of, write_certificate
from service.certificate.regime import Features, features_of
from service.history.reading import AUDIT
from service.review.doubts import Doubts
from tests.service.history.test_store import reading
from tests.service.review.test_review import PANEL

NEEDED = [(0, 299), (1, 473), (2, 628), (5, 1049), (10, 1693)]  # cases that prove at most 1 % wrong


@pytest.mark.parametrize(("wrong", "cases"), NEEDED)
def test_the_bound_is_that_of_the_exact_binomial(wrong: int, cases: int) -> None:
    assert wrong_at_most(wrong, cases) <= 0.01 < wrong_at_most(wrong, cases - 1)


def test_in_400_re_splits_at_two_percent_the_bound_fails_at_most_28_times() -> None:
    random = np.random.default_rng(2022)
    pool = np.arange(20_000) < 400
    fails = 0
    for _ in range(400):
        random.shuffle(pool)
        judged, rest = pool[:600], pool[600:]
        fails += rest.mean() > wrong_at_most(int(judged.sum()), len(judged))
    assert 4 <= fails <= 28, "about one in twenty"


def test_cases_of_one_dial_in_one_hour_count_once() -> None:
    """Without clusters the bound would claim what 24 readings of the same few dials cannot prove, and fail often."""
    random = np.random.default_rng(3)
    naive = clustered = 0
    for _ in range(300):
        dials = random.random(60) < 0.05
        cases = [(str(dial), bool(is_wrong)) for dial, is_wrong in enumerate(dials) for _ in range(24)]
        naive += wrong_at_most(sum(is_wrong for _, is_wrong in cases), len(cases)) < 0.05
        clusters, wrong = by_cluster(cases)
        clustered += wrong_at_most(wrong, clusters) < 0.05
    assert clustered <= 24 < naive


def dial(*, blur: float = 0.0, contrast: float = 1.0, add: float = 0.0, side: int = 60, glare: bool = False) -> bytes:
    """Return a picture of a dial."""
    picture = np.full((side, side), 200.0, np.float32)
    cv2.circle(picture, (side // 2, side // 2), side // 3, 40.0, 2)
    cv2.line(picture, (side // 2, side // 2), (side // 2 + side // 4, side // 3), 20.0, 2)
    picture = cv2.GaussianBlur(picture, (0, 0), blur) if blur else picture
    picture = np.clip((picture - 120.0) * contrast + 120.0 + add, 0, 249)
    if glare:
        picture[: side // 3, : side // 3] = 255
    return bytes(cv2.imencode(".png", picture.astype(np.uint8))[1])


def features(**given: Any) -> Features:
    found = features_of(dial(**given))
    assert found is not None
    return found


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """Return the file of a certificate of 300 gauges, none of them wrong."""
    random = np.random.default_rng(5)
    drawn = []
    for _ in range(300):
        light, side = random.uniform(-10, 10), int(random.integers(55, 70))
        drawn.append(features(blur=random.uniform(0.6, 1.2), contrast=random.uniform(0.8, 1.0), add=light, side=side))
    cases = [Case(kind="gauge", cluster=str(k), is_wrong=False, features=one) for k, one in enumerate(drawn)]
    file = CertificateFile(source="simulation", panel="p", version="1", made="now", sure_at=0.8, kinds=kinds_of(cases))
    write_certificate(file, tmp_path / "certificate.json")
    return tmp_path / "certificate.json"


def said(
    path: Path | None, crop: bytes | None, *, kind: str = "gauge", is_sure: bool = True, **given: Any
) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(
        Certificate(path, **{"panel": "p", "sure_at": 0.8, **given}).of(kind, crop, is_sure=is_sure)
    )
    return told


def test_a_reading_like_the_judged_ones_carries_the_bound(certificate: Path) -> None:
    told = said(certificate, dial(blur=0.9, contrast=0.9))
    assert (told["cases"], told["wrong"], told["assurance"]) == (300, 0, 0.95)
    assert told["at_most"] == pytest.approx(0.009936, abs=1e-5)


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"blur": 3.0}, "sharpness"),
        ({"contrast": 0.3}, "contrast"),
        ({"add": -60.0}, "brightness"),
        ({"side": 120}, "size"),
        ({"glare": True}, "glare"),
    ],
)
def test_a_picture_unlike_the_judged_ones_has_none_and_says_why(
    certificate: Path, changed: dict[str, Any], told: str
) -> None:
    found = said(certificate, dial(**{"blur": 0.9, "contrast": 0.9, **changed}))
    assert "at_most" not in found
    assert "not like those of the judged cases" in found["none"]
    assert told in found["none"]


def test_what_was_not_judged_has_no_certificate(certificate: Path) -> None:
    crop = dial(blur=0.9, contrast=0.9)
    assert said(certificate, crop, is_sure=False)["none"] == "it is not sure"
    assert said(certificate, crop, kind="lamp")["none"] == "no lamp was judged"
    assert said(certificate, None)["none"] == "it has no picture"
    assert "of the panel 'p'" in said(certificate, crop, panel="other")["none"]
    assert "sure at 0.8" in said(certificate, crop, sure_at=0.7)["none"]
    assert said(None, crop)["none"] == "no certificate is named in the cell file"


def test_a_damaged_certificate_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.json").write_text("{")
    with pytest.raises(ConfigError, match=r"c\.json cannot be read"):
        Certificate(tmp_path / "c.json", panel="p", sure_at=0.8)


def test_sure_readings_are_drawn_for_audits_and_stay_sure() -> None:
    draws = iter([0.3, 0.05, 0.5])
    doubts = Doubts(PANEL, sure_at=0.8, audit_share=0.1, draw=lambda: next(draws))
    told = [doubts.of(reading(k, 1.0, confidence=0.9)) for k in range(3)]
    assert told == ["", AUDIT, ""]
    assert replace(reading(0, 1.0), doubt=AUDIT).is_sure
