"""`POST /v1/read` and `panelwright read` give the same answer, refusals with a hint, errors as problems."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import httpx2
import pytest
from click.testing import Result
from typer.testing import CliRunner

from benchmarks.photographs import printed_way
from benchmarks.vision_manometers import Way, draw_manometer
from hal.errors import InvalidRequest
from perception.vision.warm import three_eights
from service.cli import _app
from service.http.photographs import EXAMPLE
from service.schema.requests import ReadPhotographRequest
from tests.service.shown_panel import house, is_problem, store, web

__all__ = ["house", "web"]  # fixtures


def run(*words: object) -> Result:
    return CliRunner().invoke(_app(), [str(word) for word in words])


@pytest.fixture
def photo(tmp_path: Path) -> Path:
    cv2.imwrite(str(tmp_path / "gauge.png"), cv2.cvtColor(draw_manometer(5).image, cv2.COLOR_RGB2BGR))
    return tmp_path / "gauge.png"


def test_both_ways_give_the_same_reading(web: httpx2.Client, photo: Path) -> None:
    image = web.post("/v1/images", content=photo.read_bytes(), headers={"Content-Type": "image/png"}).json()["id"]
    body = {"image": image, "kind": "gauge", "scale": [0.0, 10.0], "unit": "bar"}
    told = web.post("/v1/read", json=body).json()
    assert told["answered"] and told["reason"] is None and told["unit"] == "bar" and 0.5 < told["confidence"] <= 1.0
    printed = run("read", photo, "--kind", "gauge", "--scale", "0..10", "--unit", "bar", "--json")
    assert printed.exit_code == 0 and json.loads(printed.output) == told
    spoken = run("read", photo, "--kind", "gauge", "--scale", "0..10", "--unit", "bar")
    assert f"{told['value']:.4g} bar" in spoken.output


def test_the_unit_on_the_face_is_told_unless_the_caller_tells_one(tmp_path: Path) -> None:
    photo = tmp_path / "unit.png"
    drawn = draw_manometer(991000, replace(printed_way(991000), unit="bar"))
    cv2.imwrite(str(photo), cv2.cvtColor(drawn.image, cv2.COLOR_RGB2BGR))
    assert run("read", photo).output.split()[1] == "bar"
    assert run("read", photo, "--unit", "atm").output.split()[1] == "atm"


def test_of_two_pointers_the_asked_one_is_read_both_ways(web: httpx2.Client, tmp_path: Path) -> None:
    drawn = draw_manometer(200001, Way(has_red=True))
    photo = tmp_path / "two.png"
    cv2.imwrite(str(photo), cv2.cvtColor(drawn.image, cv2.COLOR_RGB2BGR))
    image = web.post("/v1/images", content=photo.read_bytes(), headers={"Content-Type": "image/png"}).json()["id"]
    body = {"image": image, "kind": "gauge", "scale": [0.0, 10.0], "ends_rad": [-2.356, 2.356]}
    both = web.post("/v1/read", json=body).json()
    assert not both["answered"] and "two pointers" in both["reason"]
    assert {seen["colour"] for seen in both["pointers"]} == {"black", "red"}
    red = web.post("/v1/read", json={**body, "pointer": "red"}).json()
    assert red["value"] == pytest.approx(drawn.red, abs=0.25)
    words = ("read", photo, "--kind", "gauge", "--scale", "0..10", "--ends=-134.99..134.99", "--pointer", "red")
    assert float(run(*words).output.split()[0]) == pytest.approx(drawn.red, abs=0.25)


def test_a_display_in_a_scene_is_read(web: httpx2.Client) -> None:
    body = {"image": store(web, three_eights()), "kind": "display", "is_scene": True}
    told = web.post("/v1/read", json=body).json()
    assert (told["text"], told["value"]) == ("88.8", 88.8)


def test_what_cannot_be_told_is_refused_with_a_reason_and_its_guess(web: httpx2.Client, photo: Path) -> None:
    image = web.post("/v1/images", content=photo.read_bytes(), headers={"Content-Type": "image/png"}).json()["id"]
    body = {"image": image, "kind": "gauge", "scale": [0.0, 10.0], "least_confidence": 1.0}
    told = web.post("/v1/read", json=body).json()
    assert not told["answered"] and told["value"] is None and told["reason"] and told["guess"]["value"] is not None
    result = run("read", photo, "--kind", "gauge", "--scale", "0..10", "--least-confidence", "1.0")
    assert result.exit_code == 1 and "cannot tell" in result.output


@pytest.mark.parametrize(
    ("body", "status", "kind", "words"),
    [
        ({"kind": "dial"}, 422, "invalid-request", "by its scale"),
        ({"kind": "display", "scale": [0.0, 1.0]}, 422, "invalid-request", "no scale"),
        ({"kind": "lever"}, 422, "bad-body", "kind"),
        ({"kind": "gauge", "scale": [0.0, 1.0], "image": "0" * 24}, 404, "no-such-image", "image"),
    ],
)
def test_what_cannot_be_meant_is_a_problem(
    web: httpx2.Client, body: dict[str, object], status: int, kind: str, words: str
) -> None:
    answer = web.post("/v1/read", json={"image": store(web, three_eights()), **body})
    is_problem(answer, status, kind, words)


def test_the_path_of_earlier_versions_answers_the_same(web: httpx2.Client) -> None:
    body = {"image": store(web, three_eights()), "kind": "display", "is_scene": True}
    assert web.post("/v1/read-photograph", json=body).json() == web.post("/v1/read", json=body).json()
    assert "/v1/read-photograph" not in web.get("/openapi.json").json()["paths"]


def test_nothing_need_be_told_and_the_picture_shows_what_was_found(web: httpx2.Client, tmp_path: Path) -> None:
    seed, photo, drawn = 995005, tmp_path / "scene.png", tmp_path / "read.png"
    gauge = draw_manometer(seed, printed_way(seed))
    cv2.imwrite(str(photo), cv2.cvtColor(gauge.image, cv2.COLOR_RGB2BGR))
    image = web.post("/v1/images", content=photo.read_bytes(), headers={"Content-Type": "image/png"}).json()["id"]
    told = web.post("/v1/read", json={"image": image}).json()
    assert told["kind"] == "gauge" and told["answered"], told
    assert told["value"] == pytest.approx(gauge.reading / 10 * gauge.full, abs=0.025 * gauge.full)
    assert told["scale"]["maximum"] == gauge.full and told["face"]["right"][0] > 0.0 and told["motion"] is None
    spoken = run("read", photo, "--picture", drawn)
    assert spoken.exit_code == 0 and f"{told['value']:.4g}" in spoken.output
    shown = cv2.imread(str(drawn))
    assert shown is not None and shown.shape == gauge.image.shape
    assert (shown.astype(int) - cv2.cvtColor(gauge.image, cv2.COLOR_RGB2BGR)).any()


def test_several_pictures_of_one_gauge_tell_how_it_moves(web: httpx2.Client, tmp_path: Path) -> None:
    seed, images, photos = 995005, [], []
    for k, share in enumerate((0.4, 0.45, 0.5)):
        photos.append(tmp_path / f"{k}.png")
        gauge = draw_manometer(seed, printed_way(seed), share)
        cv2.imwrite(str(photos[-1]), cv2.cvtColor(gauge.image, cv2.COLOR_RGB2BGR))
        images.append(store(web, gauge.image))
    body = {
        "image": images[0],
        "further": images[1:],
        "kind": "gauge",
        "scale": [0.0, 10.0],
        "ends_rad": [-2.356, 2.356],
    }
    told = web.post("/v1/read", json=body).json()
    assert told["value"] == pytest.approx(4.5, abs=0.1) and told["motion"]["trend"] == pytest.approx(0.5, abs=0.1)
    assert len(told["motion"]["values"]) == 3
    spoken = run("read", *photos, "--kind", "gauge", "--scale", "0..10", "--ends=-134.99..134.99")
    assert "mean of 3 of 3 pictures" in spoken.output and "trend +0.5" in spoken.output


def test_a_range_that_is_none_is_refused(photo: Path) -> None:
    result = run("read", photo, "--kind", "gauge", "--scale", "10")
    assert isinstance(result.exception, InvalidRequest) and "--scale=0..10" in result.exception.hint


def test_the_example_is_a_request() -> None:
    ReadPhotographRequest.model_validate_json(json.dumps(EXAMPLE))
