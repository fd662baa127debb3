"""Tests of `/v1/knowledge`: an outline at a click, a new kind, a whole panel, and refusals."""

from __future__ import annotations

import tomllib
from collections.abc import Callable

import httpx2
import numpy as np
import pytest

from hal.panel import Panel
from hal.strict import parse_toml
from perception.vision.knowledge_files import KindRecord
from service.serve import Panelwright
from tests.perception.vision.bench_panel import panel
from tests.service.shown_panel import (
    PLATE,
    SHOWING_NO_PANEL,
    Shown,
    corners,
    house,
    is_problem,
    shown,
    store,
    web,
)

__all__ = ["house", "shown", "web"]  # fixtures


def middle(shown: Shown, name: str) -> list[list[float]]:
    return shown[1].project([panel().object(name).point_m]).tolist()


def test_an_outline_is_found_at_one_click_and_named(web: httpx2.Client, shown: Shown) -> None:
    body = {"image": store(web, shown[0]), "plate_m": PLATE, "clicks_px": middle(shown, "mode")}
    before = web.get("/v1/knowledge?toml=false").json()
    found = web.post("/v1/knowledge/outline", json=body).json()
    assert found["shape"] == "circle" and found["taken_for"] == "rotary"
    assert np.allclose(found["size_m"], 0.044, atol=0.004)
    assert np.allclose(np.mean(found["outline_px"], axis=0), middle(shown, "mode")[0], atol=10.0)
    assert web.get("/v1/knowledge?toml=false").json() == before, "looking writes nothing"


def test_a_new_kind_is_taught_listed_found_and_forgotten(web: httpx2.Client, shown: Shown) -> None:
    image = store(web, shown[0])
    body = {"image": image, "plate_m": PLATE, "kind": "mushroom", "clicks_px": corners(shown[1], "emergency", 0.02)}
    taught = web.post("/v1/knowledge/teach", json=body)
    assert taught.status_code == 200, taught.text
    lesson = taught.json()
    assert lesson["added"] and lesson["is_new"] and lesson["outline"]["taken_for"] == "mushroom"
    assert parse_toml(lesson["toml"], KindRecord, source="answer").name == "mushroom"
    listed = {kind["name"]: kind for kind in web.get("/v1/knowledge").json()["kinds"]}
    assert listed["mushroom"]["is_taught"] and listed["mushroom"]["toml"] == lesson["toml"]
    assert not listed["gauge"]["is_taught"] and tomllib.loads(listed["gauge"]["toml"])["name"] == "gauge"
    again = web.post("/v1/knowledge/teach", json=body).json()
    assert not again["added"] and again["path"] is None
    look = {"image": image, "mode": "blind", "plate_m": PLATE}
    found = web.post("/v1/recognise?wait_s=30", json=look).json()["result"]["candidates"]
    assert [c["kind"] for c in found if c["reason"] is None].count("mushroom") == 1
    assert web.delete("/v1/knowledge/kinds/mushroom").status_code == 204
    is_problem(web.delete("/v1/knowledge/kinds/mushroom"), 404, "no-such-knowledge", "no taught kind")
    is_problem(web.delete("/v1/knowledge/kinds/gauge"), 404, "no-such-knowledge", "no taught kind")


def test_a_plate_whose_corners_are_told_is_not_looked_for(web: httpx2.Client, shown: Shown) -> None:
    picture, view = shown
    room = np.full((2 * picture.shape[0], 2 * picture.shape[1], *picture.shape[2:]), 120, np.uint8)
    room[100 : 100 + picture.shape[0], 150 : 150 + picture.shape[1]] = picture
    half_m, off_px = np.array([*PLATE, 0.0]) / 2, np.array([150.0, 100.0])
    told = view.project(half_m * [[1, 1, 0], [-1, -1, 0], [-1, 1, 0], [1, -1, 0]]) + off_px
    look = {"image": store(web, room), "plate_m": PLATE}
    click = {"clicks_px": (np.array(middle(shown, "mode")) + off_px).tolist()}
    is_problem(web.post("/v1/knowledge/outline", json={**look, **click}), 409, "not-found", "plate")
    look["corners_px"] = told.tolist()
    assert web.post("/v1/knowledge/outline", json={**look, **click}).json()["taken_for"] == "rotary"
    found = web.post("/v1/recognise?wait_s=30", json={**look, "mode": "blind"}).json()["result"]["candidates"]
    rotaries = [c["centre_px"] for c in found if c["kind"] == "rotary" and c["reason"] is None]
    assert np.linalg.norm(np.array(rotaries) - click["clicks_px"], axis=1).min() < 10.0
    refused = web.post(
        "/v1/knowledge/outline", json={**look, **click, "corners_px": [[0, 0], [9, 9], [20, 20], [30, 30]]}
    )
    is_problem(refused, 422, "invalid-request", "corners")


def test_a_whole_panel_is_taught_and_read(web: httpx2.Client, shown: Shown, house: Panelwright) -> None:
    image = store(web, shown[0])
    objects = [
        {"kind": "gauge", "name": "pressure", "clicks_px": middle(shown, "pressure"), "answers": {"unit": "kPa"}},
        {"kind": "display", "name": "flow", "clicks_px": middle(shown, "flow"), "answers": {"decimals": "1"}},
        {"kind": "mushroom", "name": "halt", "clicks_px": corners(shown[1], "emergency", 0.02)},
    ]
    body = {"image": image, "plate_m": PLATE, "panel": {"name": "pump_room", "objects": objects}}
    taught = web.post("/v1/knowledge/teach", json=body)
    assert taught.status_code == 200, taught.text
    made = parse_toml(taught.json()["toml"], Panel, source="answer")
    assert [panel_object.name for panel_object in made.objects] == ["pressure", "flow", "halt"]
    known = web.get("/v1/knowledge").json()
    panels = {p["name"]: p for p in known["panels"]}
    assert panels["pump_room"]["is_taught"] and panels["pump_room"]["toml"] == taught.json()["toml"]
    own = house.service.cell.panel
    assert parse_toml(panels[own.name]["toml"], Panel, source="answer") == own
    assert {"panel": "pump_room", "name": "halt"}.items() <= known["objects"][-1].items()
    rows = web.post("/v1/inspect?wait_s=30", json={"image": image, "panel": "pump_room"}).json()["result"]["objects"]
    values = {row["name"]: row for row in rows}
    assert values["pressure"]["value"] == pytest.approx(6.3, abs=0.2) and values["pressure"]["unit"] == "kPa"
    assert values["flow"]["text"] == "47.3"


def test_lessons_that_cannot_be_are_refused_and_write_nothing(web: httpx2.Client, shown: Shown) -> None:
    image, view = store(web, shown[0]), shown[1]
    before = web.get("/v1/knowledge?toml=false").json()
    bare = view.project([[0.12, -0.15, 0.0]]).tolist()
    base = {"image": image, "plate_m": PLATE}
    panel_object = {"kind": "gauge", "name": "a", "clicks_px": middle(shown, "pressure")}
    for status, body in (
        (409, {**base, "kind": "pump", "clicks_px": bare}),
        (409, {**base, "kind": "pump", "clicks_px": [[1.0, 1.0]]}),
        (422, {**base, "kind": "../up", "clicks_px": bare}),
        (422, {**base, "kind": "pump", "clicks_px": []}),
        (422, {**base, "kind": "pump", "clicks_px": bare * 4}),
        (422, {**base}),
        (422, {**base, "panel": {"name": "p", "objects": []}}),
        (422, {**base, "panel": {"name": "p", "objects": [panel_object, panel_object]}}),
        (422, {**base, "panel": {"name": "p", "objects": [{**panel_object, "kind": "pyramid"}]}}),
        (422, {**base, "panel": {"name": "p", "objects": [{**panel_object, "answers": {"minimum": "much"}}]}}),
        (404, {**base, "image": "0" * 24, "kind": "pump", "clicks_px": bare}),
    ):
        answer = web.post("/v1/knowledge/teach", json=body)
        assert answer.status_code == status, (body, answer.text)
        assert answer.json()["hint"]
    assert web.get("/v1/knowledge?toml=false").json() == before


def test_the_questions_of_a_kind_are_served(web: httpx2.Client) -> None:
    asked = web.get("/v1/knowledge/questions?kind=gauge").json()["questions"]
    assert [q["key"] for q in asked] == ["name", "minimum", "maximum", "unit", "at_min", "at_max"]
    assert web.get("/v1/knowledge/questions?kind=pyramid").status_code == 422


def test_one_kind_and_one_panel_are_shown(web: httpx2.Client, house: Panelwright) -> None:
    gauge = web.get("/v1/knowledge/kinds/gauge").json()
    assert not gauge["is_taught"] and parse_toml(gauge["toml"], KindRecord, source="answer").name == "gauge"
    own = house.service.cell.panel
    assert parse_toml(web.get(f"/v1/knowledge/panels/{own.name}").json()["toml"], Panel, source="answer") == own
    is_problem(web.get("/v1/knowledge/kinds/teapot"), 404, "no-such-knowledge", "there is no kind or panel")
    is_problem(web.get("/v1/knowledge/panels/teapot"), 404, "no-such-knowledge", "there is no kind or panel")


@pytest.mark.parametrize("lesson", ["outline", "kind", "panel"])
@SHOWING_NO_PANEL
def test_images_that_teach_nothing_are_refused_with_the_reason(
    web: httpx2.Client, shown: Shown, lesson: str, change: Callable[[np.ndarray], np.ndarray], kind: str, words: str
) -> None:
    image = store(web, np.ascontiguousarray(change(shown[0])))
    before = web.get("/v1/knowledge?toml=false").json()
    clicks = {"clicks_px": middle(shown, "pressure")}
    panel_object = {"kind": "gauge", "name": "a", **clicks}
    more = {
        "outline": clicks,
        "kind": {"kind": "pump", **clicks},
        "panel": {"panel": {"name": "p", "objects": [panel_object]}},
    }
    path = "/v1/knowledge/outline" if lesson == "outline" else "/v1/knowledge/teach"
    is_problem(web.post(path, json={"image": image, "plate_m": PLATE, **more[lesson]}), 409, kind, words)
    assert web.get("/v1/knowledge?toml=false").json() == before
