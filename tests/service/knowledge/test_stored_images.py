"""Tests of stored images over HTTP: uploads are checked, kept, read blind and taught; bad ones are refused."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest
from PIL import Image as Pillow

from perception.vision.projection import CameraProjection
from service.serve import Panelwright
from tests.perception.vision.bench_panel import panel, scene
from tests.service.shown_panel import PLATE, SHOWING_NO_PANEL, Shown, ask, house, is_problem, png, shown, store, web

__all__ = ["house", "shown", "web"]  # fixtures


def test_an_image_is_kept_listed_fetched_and_deleted(web: httpx2.Client, shown: Shown) -> None:
    first = store(web, shown[0])
    assert store(web, shown[0]) == first, "the same image has the same id"
    listed = {image["id"]: image for image in web.get("/v1/images").json()["images"]}
    assert (listed[first]["width_px"], listed[first]["height_px"]) == (1280, 960)
    assert web.get(f"/v1/images/{first}").content == png(shown[0])
    assert web.delete(f"/v1/images/{first}").status_code == 204
    is_problem(web.get(f"/v1/images/{first}"), 404, "no-such-image", "no stored image")


def _truncated() -> bytes:
    return png(scene(size=(320, 240))[0])[:-2000]


def _deep(channels: int) -> bytes:
    return cv2.imencode(".png", np.zeros((40, 40, channels), np.uint16))[1].tobytes()


def _huge() -> bytes:
    stream = io.BytesIO()
    Pillow.new("1", (10_000, 10_000)).save(stream, "PNG")
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (lambda: b"", "not an image"),
        (lambda: b"<svg/>", "not an image"),
        (lambda: png(np.zeros((1, 1), np.uint8)), "1x1"),
        (lambda: _deep(1), "8 bits"),
        (lambda: _deep(3), "8 bits"),
        (_huge, "10000x10000"),
        (_truncated, "damaged"),
    ],
)
def test_what_is_no_usable_image_is_not_kept(web: httpx2.Client, data: Callable[[], bytes], words: str) -> None:
    before = web.get("/v1/images").json()
    answer = web.post("/v1/images", content=data(), headers={"Content-Type": "image/png"})
    is_problem(answer, 422, "invalid-request", words)
    assert web.get("/v1/images").json() == before


def test_an_upload_says_that_it_is_an_image_and_is_bounded(web: httpx2.Client, shown: Shown) -> None:
    for media in ("text/plain", "multipart/form-data", "application/json"):
        answer = web.post("/v1/images", content=png(shown[0]), headers={"Content-Type": media})
        is_problem(answer, 415, "bad-body", "not an image type")
    answer = web.post("/v1/images", content=b" " * 32_000_001, headers={"Content-Type": "image/png"})
    assert answer.status_code == 413


def test_a_taught_panel_is_read_with_and_without_a_lens(web: httpx2.Client, shown: Shown) -> None:
    image, view = shown
    lens = view.intrinsics
    optics = {"fx_px": lens.fx_px, "fy_px": lens.fy_px, "cx_px": lens.cx_px, "cy_px": lens.cy_px,
              "distortion": list(lens.distortion)}  # fmt: skip
    stored = store(web, image)
    for more in ({}, {"lens": optics}):
        for verb, mode in (("inspect", {}), ("recognise", {"mode": "taught"})):
            task = ask(web, verb, {"image": stored, **mode, **more})
            assert task.status_code == 200, task.text
            result = task.json()["result"]
            rows = {row["name"]: row for row in result["objects"]}
            assert rows["pressure"]["value"] == pytest.approx(6.3, abs=0.2)
            assert rows["flow"]["text"] == "47.3"
            picture = web.get(result["pictures"][0])
            assert picture.headers["content-type"] == "image/png"
            assert np.asarray(Pillow.open(io.BytesIO(picture.content))).shape == (960, 1280, 3)


def test_a_stored_image_needs_neither_lease_nor_a_clear_stop_and_teaches_the_cell_nothing(
    web: httpx2.Client, house: Panelwright, shown: Shown
) -> None:
    stored = store(web, shown[0])
    web.post("/v1/stop")
    task = ask(web, "inspect", {"image": stored, "objects": ["pressure"]})
    assert task.status_code == 200 and task.json()["moves"] is False
    assert not house.service.world.readings
    assert web.post("/v1/stop/reset", json={"seen_count": web.get("/v1/stop").json()["count"]}).status_code == 200


def test_blind_recognition_draws_what_it_finds(web: httpx2.Client, shown: Shown) -> None:
    answer = ask(web, "recognise", {"image": store(web, shown[0]), "mode": "blind", "plate_m": PLATE})
    assert answer.status_code == 200, answer.text
    result = answer.json()["result"]
    assert any(c["kind"] == "rotary" and c["reason"] is None for c in result["candidates"])
    assert web.get(result["pictures"][0]).content.startswith(b"\x89PNG")


def _bare(image: np.ndarray, view: CameraProjection) -> np.ndarray:
    """Return the image with the emergency mushroom painted over by plate."""
    u, v = np.rint(view.project([panel().object("emergency").point_m])[0]).astype(int)
    out = image.copy()
    out[v - 60 : v + 60, u - 60 : u + 60] = np.median(image[v - 70 : v - 60, u - 70 : u + 70])
    return out


@pytest.mark.parametrize("mode", [{"mode": "blind", "plate_m": PLATE}, {"mode": "blind"}])
@SHOWING_NO_PANEL
def test_blind_recognition_refuses_what_shows_no_panel_or_two(
    web: httpx2.Client, shown: Shown, mode: dict[str, Any], change: Callable[[np.ndarray], np.ndarray], kind: str,
    words: str,
) -> None:  # fmt: skip
    stored = store(web, np.ascontiguousarray(change(shown[0])))
    is_problem(ask(web, "recognise", {"image": stored, **mode}), 409, kind, words)


@pytest.mark.parametrize("verb", ["inspect", "recognise"])
@pytest.mark.parametrize(
    ("change", "more", "kind", "words"),
    [
        (np.zeros_like, {}, "not-observable", "black"),
        (lambda image: np.full_like(image, 255), {}, "not-observable", "saturated"),
        (lambda image: np.full_like(image, 90), {}, "not-found", "no plate"),
        (lambda image: np.hstack([image, image]), {}, "ambiguous", "two panels"),
        (lambda image: image[::-1, ::-1], {}, "not-found", "upside down"),
        (lambda image: image, {"panel": "nobody"}, "no-such-knowledge", "no panel"),
        (lambda image: image, {"camera": "wrist_camera"}, None, ""),
        (lambda image: image, {"wrong": True}, "not-found", "does not show panel"),
    ],
    ids=["black", "saturated", "nothing", "two", "upside down", "unknown panel", "no lens", "wrong calibration"],
)
def test_what_an_image_cannot_answer_is_refused_with_a_reason(
    web: httpx2.Client, shown: Shown, verb: str, change: Callable[[np.ndarray], np.ndarray], more: dict[str, Any],
    kind: str | None, words: str,
) -> None:  # fmt: skip
    image, view = shown
    if more.get("wrong"):
        pose = view.camera_from_panel.parent_from_child
        more = {
            "lens": {"fx_px": 900.0, "fy_px": 900.0, "cx_px": 500.0, "cy_px": 300.0},
            "camera_from_panel": {
                "translation_m": pose.translation.tolist(),
                "quaternion_xyzw": pose.rotation.as_quat().tolist(),
                "covariance": (1e-6 * np.eye(6)).tolist(),
            },
        }
    answer = ask(web, verb, {"image": store(web, np.ascontiguousarray(change(image))), **more})
    assert 400 <= answer.status_code < 500, answer.text
    if kind is not None:
        is_problem(answer, 404 if kind.startswith("no-such") else 409, kind, words)


def test_an_object_that_is_not_there_and_one_in_glare_are_said(web: httpx2.Client, shown: Shown) -> None:
    image, view = shown
    dazzled = _bare(image, view)
    u, v = np.rint(view.project([panel().object("pressure").point_m])[0]).astype(int)
    cv2.circle(dazzled, (int(u), int(v)), 78, 255, -1)
    rows = {row["name"]: row for row in ask(web, "inspect", {"image": store(web, dazzled)}).json()["result"]["objects"]}
    assert not rows["emergency"]["present"] and "bare plate" in rows["emergency"]["reason"]
    assert rows["pressure"]["value"] is None and rows["pressure"]["reason"]


def test_the_caller_chooses_how_sure_is_sure_enough(web: httpx2.Client, shown: Shown) -> None:
    image, view = shown
    x, y = panel().object("flow").position_m
    ends = np.rint(view.project([[x + 0.012, y + 0.08, 0.0], [x + 0.012, y - 0.08, 0.0]])).astype(int).tolist()
    stored = store(web, np.asarray(cv2.line(image.copy(), tuple(ends[0]), tuple(ends[1]), 35, 9)))
    for verb in ("inspect", "recognise"):

        def flow(_verb: str = verb, **least: float) -> dict[str, Any]:
            task = ask(web, _verb, {"image": stored, "objects": ["flow"], **least})
            row: dict[str, Any] = task.json()["result"]["objects"][0]
            return row

        default, less, more = flow(), flow(least_confidence=0.0), flow(least_confidence=1.0)
        assert default["text"] is None and default["reason"] and len(default["possible"]) > 1
        assert less["text"] == default["possible"][0]["text"] and less["reason"] is None
        assert less["possible"] == default["possible"] and less["confidence"] == default["confidence"] < 0.5
        assert more["text"] is None and more["reason"]


def test_requests_that_make_no_sense_are_refused(web: httpx2.Client, shown: Shown) -> None:
    stored = store(web, shown[0])
    for verb, body in (
        ("recognise", {"plate_m": PLATE}),
        ("recognise", {"image": stored, "use": ["range"]}),
        ("recognise", {"image": "../../etc/passwd"}),
        ("recognise", {"image": stored, "plate_m": [0.6, -1.0], "mode": "blind"}),
        ("recognise", {"image": stored, "mode": "blind", "least_confidence": 0.2}),
        ("recognise", {"image": stored, "least_confidence": 1.01}),
        ("inspect", {"image": stored, "least_confidence": -0.1}),
        ("inspect", {"image": stored, "camera_from_panel": {"translation_m": [0, 0, 1]}}),
    ):
        answer = ask(web, verb, body)
        assert answer.status_code == 422, answer.text
    is_problem(ask(web, "inspect", {"image": "0" * 24}), 404, "no-such-image", "no stored image")
