"""Tests of learning from a known panel: over HTTP from a stored image, from a file, and the looks of a cell file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import httpx2
import numpy as np
import pytest

from hal.config import load_cell
from hal.errors import ConfigError, InvalidRequest, NotFound
from hal.geometry import to_json
from perception.vision.knowledge import TaughtKind
from perception.vision.knowledge_files import load_knowledge, write_kind
from service.commands.teach import teach
from service.knowledge.store import KnowledgeStore
from tests.perception.vision.bench_panel import TOML, panel, scene
from tests.service.conftest import WriteCell
from tests.service.shown_panel import (
    PLATE,
    SHOWING_NO_PANEL,
    Shown,
    ask,
    house,
    is_problem,
    png,
    shown,
    store,
    web,
)

__all__ = ["house", "shown", "web"]  # fixtures
NAMES = [panel_object.name for panel_object in panel().objects]


def blind(web: httpx2.Client, image: str) -> list[str]:
    look = {"image": image, "mode": "blind", "plate_m": PLATE}
    found = ask(web, "recognise", look).json()["result"]["candidates"]
    return [candidate["kind"] for candidate in found if candidate["reason"] is None]


def forget(web: httpx2.Client) -> None:
    for kind in web.get("/v1/knowledge?toml=false").json()["kinds"]:
        if kind["is_taught"]:
            assert web.delete(f"/v1/knowledge/kinds/{kind['name']}").status_code == 204


def test_a_stored_overview_teaches_what_another_one_shows(web: httpx2.Client, shown: Shown) -> None:
    other, _, _ = scene(tilt_deg=9.0, azimuth_deg=120.0, distance_m=0.7, shown={"mode": "off"}, seed=3)
    forget(web)  # what this test taught, if it is tried again
    before = blind(web, store(web, other))
    answer = ask(web, "learn", {"image": store(web, shown[0])})
    assert answer.status_code == 200, answer.text
    taught = answer.json()["result"]
    assert taught["taught_by"] == NAMES and not taught["left_out"]
    assert set(taught["known_before"]) < set(taught["known_now"])
    picture = web.get(taught["pictures"][0])
    assert cv2.imdecode(np.frombuffer(picture.content, np.uint8), cv2.IMREAD_COLOR).shape == (960, 1280, 3)
    kinds = {kind["name"]: kind for kind in web.get("/v1/knowledge?toml=false").json()["kinds"]}
    assert {name for name, kind in kinds.items() if kind["is_taught"]} == set(taught["added"])
    now = blind(web, store(web, other))
    assert "mushroom" not in before and now.count("mushroom") == 1 and len(now) > len(before)
    again = ask(web, "learn", {"image": store(web, shown[0])}).json()["result"]
    assert again["added"] == {} and again["files"] == []
    forget(web)
    assert blind(web, store(web, other)) == before, "what was taught is forgotten"


def test_a_pose_and_a_lens_may_come_along(web: httpx2.Client, shown: Shown) -> None:
    view = shown[1]
    lens = {key: getattr(view.intrinsics, key) for key in ("fx_px", "fy_px", "cx_px", "cy_px")}
    pose = {
        **to_json(view.camera_from_panel.parent_from_child),
        "covariance": view.camera_from_panel.covariance.tolist(),
    }
    body = {"image": store(web, shown[0]), "lens": lens, "camera_from_panel": pose}
    task = ask(web, "learn", body).json()
    assert task["state"] == "succeeded" and task["result"]["known_now"] == NAMES
    forget(web)


@SHOWING_NO_PANEL
def test_what_shows_no_panel_teaches_nothing(
    web: httpx2.Client, shown: Shown, change: Callable[[np.ndarray], np.ndarray], kind: str, words: str
) -> None:
    before = web.get("/v1/knowledge?toml=false").json()
    stored = store(web, np.ascontiguousarray(change(shown[0])))
    is_problem(web.post("/v1/learn?wait_s=30", json={"image": stored}), 409, kind, words)
    assert web.get("/v1/knowledge?toml=false").json() == before


def test_an_unknown_image_and_a_pose_without_a_lens_are_refused(web: httpx2.Client, shown: Shown) -> None:
    is_problem(web.post("/v1/learn?wait_s=30", json={"image": "0" * 24}), 404, "no-such-image", "no stored image")
    assert web.post("/v1/learn", json={"panel": "x"}).status_code == 422


def test_a_panel_file_teaches_from_an_image_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, _, _ = scene(tilt_deg=3.0, distance_m=0.66)
    (tmp_path / "panel.png").write_bytes(png(image))
    (tmp_path / "panel.toml").write_text(TOML.replace('style = "lcd" }', 'style = "lcd", minimum = -99.0 }'))
    teach(tmp_path / "panel.png", folder=tmp_path / "kinds", from_panel=tmp_path / "panel.toml")
    told = capsys.readouterr().out
    assert f"{len(NAMES)} objects looked at" in told and "mushroom.toml" in told
    assert load_knowledge(tmp_path / "kinds").kind("mushroom") is not None
    with pytest.raises(InvalidRequest, match="give one of"):
        teach(tmp_path / "panel.png", folder=tmp_path, from_panel=tmp_path / "panel.toml", check=True)
    turned = np.ascontiguousarray(image[::-1, ::-1])
    (tmp_path / "turned.png").write_bytes(png(turned))
    with pytest.raises(NotFound, match="upside down"):
        teach(tmp_path / "turned.png", folder=tmp_path / "none", from_panel=tmp_path / "panel.toml")
    assert not (tmp_path / "none").exists()


def test_the_looks_of_a_cell_add_to_the_shipped_kinds_and_give_way_to_taught_ones(tmp_path: Path) -> None:
    shipped = load_knowledge()
    lamp = shipped.kind("lamp")
    assert lamp is not None
    odd = np.full((1, lamp.looks.shape[1]), 0.5)
    of_cell, folder = tmp_path / "cell", tmp_path / "taught"
    of_cell.mkdir()
    write_kind(TaughtKind(name="lamp", size_m=lamp.size_m, looks=odd), of_cell)
    write_kind(TaughtKind(name="bell", size_m=(0.02, 0.02), looks=odd), of_cell)
    store = KnowledgeStore(folder, of_cell=of_cell)
    known = store.knowledge()
    both, bell = known.kind("lamp"), known.kind("bell")
    assert both is not None and len(both.looks) == len(lamp.looks) + 1 and bell is not None
    files = {file.name: file for file in store.kinds()}
    assert files["lamp"].summary().looks == len(both.looks) and not files["lamp"].is_taught
    assert files["bell"].summary().looks == 1 and not files["bell"].is_taught
    (tmp_path / "shown").mkdir()
    (tmp_path / "shown" / "lamp.toml").write_text(files["lamp"].text())
    (read,) = load_knowledge(tmp_path / "shown").kinds
    np.testing.assert_array_equal(read.looks, both.looks)
    store.write_kind(TaughtKind(name="lamp", size_m=lamp.size_m, looks=odd))
    alone = store.knowledge().kind("lamp")
    assert alone is not None and len(alone.looks) == 1


def test_a_cell_file_whose_looks_are_gone_is_refused(write_cell: WriteCell) -> None:
    path = write_cell()
    assert load_cell(path).knowledge_path is None
    path.write_text(path.read_text().replace("seed = 3", 'seed = 3\nknowledge = "no/such"'))
    with pytest.raises(ConfigError, match=r"cell\.knowledge: 'no/such' does not exist"):
        load_cell(path)
