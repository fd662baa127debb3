"""Tests of the review: what is doubted, what an answer changes, over HTTP and on the command line."""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from typer.testing import CliRunner

from hal.errors import InvalidRequest
from hal.panel import Panel
from hal.strict import validate
from perception.vision import CameraProjection
from perception.vision.teaching import surroundings
from service.cli import _app
from service.errors import NotPossibleNow
from service.history.parts import part_path, read_parts, write_parquet
from service.history.reading import COLUMNS
from service.history.store import ALL
from service.report.plots import png_of
from service.review.desk import ReviewDesk
from service.review.doubts import Doubts
from service.serve import Panelwright
from tests.perception.vision.bench_panel import panel, scene
from tests.service.history.test_store import NOW_S, history_in, reading

GAUGE = {
    "kind": "gauge", "name": "pressure", "position_m": [0.0, 0.0], "radius_m": 0.03,
    "scale": {"minimum": 0.0, "maximum": 10.0, "unit": "bar", "at_min": -2.3, "at_max": 2.3},
    "limits": {"rate_per_s": 0.5},
}  # fmt: skip
LAMP = {"kind": "lamp", "name": "pump", "position_m": [0.1, 0.1], "radius_m": 0.01}
PANEL = validate({"name": "p", "width_m": 0.6, "height_m": 0.4, "objects": [GAUGE, LAMP]}, Panel, source="panel.toml")
GUESS = json.dumps({"held": {"value": 4.0}, "possible": []})


def doubted(*readings: Any) -> list[bool]:
    """Return for each reading in turn whether it is doubted."""
    doubts = Doubts(PANEL, sure_at=0.8)
    return [doubts.of(one) != "" for one in readings]


def test_a_refusal_and_a_weak_reading_are_doubted() -> None:
    assert doubted(reading(0, None), reading(1, 1.0, confidence=0.79), reading(2, 1.0, confidence=0.8)) == [
        True,
        True,
        False,
    ]


def test_a_jump_is_doubted_once_and_one_misread_blocks_nothing() -> None:
    values = [reading(k, v, confidence=0.9) for k, v in ((0, 1.0), (10, 9.9), (20, 1.0), (30, 1.1), (40, 1.2))]
    assert doubted(*values) == [False, True, True, False, False]
    assert doubted(reading(0, 1.0, confidence=0.9), reading(10, 6.1, sigma=0.1, confidence=0.9)) == [False, False]


def test_a_counter_that_goes_back_is_doubted() -> None:
    counts = [
        reading(k, v, object="hours", kind="counter", confidence=0.9) for k, v in ((0, 41.0), (1, 42.0), (2, 40.0))
    ]
    assert doubted(*counts) == [False, False, True]


def desk_of(tmp_path: Path) -> tuple[ReviewDesk, Any, list[dict[str, Any]]]:
    history, journal = history_in(tmp_path), list[dict[str, Any]]()
    desk = ReviewDesk(
        history, PANEL, cell="bench", commit=lambda _kind, data: journal.append(data), now_s=lambda: NOW_S
    )
    return desk, history, journal


def test_an_answer_corrects_the_trend_and_both_values_stay(tmp_path: Path) -> None:
    desk, history, journal = desk_of(tmp_path)
    weak = reading(2, None, guess=GUESS, doubt="it jumped")
    history.add([reading(0, 1.0), reading(1, 9.0, doubt="it jumped"), weak, reading(3, 2.0, doubt="it jumped")])
    count, rows = desk.waiting()
    assert (count, [row.id for row in rows]) == (3, [4, 3, 2])
    desk.answer(2, by="alice", verdict="wrong", reason="glare", shows={"value": 3.0})
    desk.answer(3, by="alice", verdict="right", reason="seen on site", shows={})
    desk.answer(4, by="alice", verdict="unreadable", reason="blurred", shows={})
    assert desk.waiting() == (0, [])
    (bucket,) = history.reader().trend(history.ask(object="pressure"), buckets=1)
    assert (bucket.count, bucket.refused, bucket.minimum, bucket.maximum) == (4, 1, 1.0, 4.0)
    corrected = history.row(2).reading
    assert (corrected.value, corrected.final_value, json.loads(corrected.answered)["by"]) == (9.0, 3.0, "alice")
    assert [row["verdict"] for row in journal] == ["wrong", "right", "unreadable"]
    with pytest.raises(NotPossibleNow, match="has an answer already"):
        desk.answer(2, by="bob", verdict="right", reason="no", shows={})
    with pytest.raises(NotPossibleNow, match="is sure"):
        desk.answer(1, by="bob", verdict="right", reason="no", shows={})


@pytest.mark.parametrize(
    ("number", "verdict", "shows", "told"),
    [
        (1, "wrong", {}, "says what the object shows"),
        (1, "wrong", {"state": "on"}, "shows no state"),
        (1, "right", {}, "nothing that could be right"),
        (1, "unreadable", {"value": 1.0}, "comes without value"),
        (2, "wrong", {"state": "dim"}, "one of its states"),
        (2, "wrong", {"value": 1.0}, "one of its states"),
    ],
)
def test_an_answer_that_cannot_be_meant_is_refused(
    tmp_path: Path, number: int, verdict: Any, shows: dict[str, Any], told: str
) -> None:
    desk, history, journal = desk_of(tmp_path)
    history.add([reading(0, None, doubt="x"), reading(1, None, object="pump", kind="lamp", doubt="x")])
    with pytest.raises(InvalidRequest, match=told):
        desk.answer(number, by="alice", verdict=verdict, reason="r", shows=shows)
    assert (desk.waiting()[0], journal) == (2, [])


def test_a_history_of_the_first_version_is_taken_over_with_its_parts(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    history.add([reading(0, 1.0), reading(1, 2.0)])
    history.close()
    newer = COLUMNS[-6:]
    with sqlite3.connect(tmp_path / "history.sqlite") as db:
        db.execute("DROP INDEX readings_in_doubt")
        for column in newer:
            db.execute(f"ALTER TABLE readings DROP COLUMN {column}")
        db.execute("PRAGMA user_version=1")
    again = history_in(tmp_path)
    again.add([reading(2, 3.0, doubt="x")])
    assert [row.reading.value for row in again.reader().page(again.ask())] == [1.0, 2.0, 3.0]
    old = [name for name in ALL if name not in newer]
    given = {"id": 1, "value": 1.5, "utc_s": NOW_S, "cell_s": 0.0, "sigma": 0.0, "confidence": 0.9}
    part = part_path(tmp_path, 1, 1)
    write_parquet(part, old, [[given.get(name, "x") for name in old]])
    assert read_parts([part], "value, doubt, final_value", "", []) == [(1.5, "", None)]


def around(name: str) -> bytes:
    """Return a picture of an object of the drawn bench and the plate around it, as the history keeps it."""
    image, intrinsics, pose = scene(tilt_deg=4.0, distance_m=0.62)
    view = CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)
    point_m = panel().object(name).point_m
    picture = surroundings(image, view, point_m, view.project([point_m])[0])
    assert picture is not None
    return png_of(picture)


@pytest.fixture
def waiting(served: Panelwright, client: httpx2.Client) -> Iterator[int]:
    """Yield the number of a reading that waits."""
    guess = json.dumps({"held": {"state": "on"}, "possible": []})
    crop = served.service.plant.history.crops.add(b"\x89PNG a lamp")
    one = reading(0, None, object="pump_lamp", kind="lamp", guess=guess, doubt="it was refused: glare", crop=crop)
    served.service.plant.history.add([one])
    yield client.get("/v1/review").json()["readings"][0]["reading"]["id"]


def test_a_waiting_reading_is_shown_with_its_guess_and_answered_over_http(client: httpx2.Client, waiting: int) -> None:
    (item,) = client.get("/v1/review").json()["readings"]
    assert (item["why"], item["guess"]["state"], item["reading"]["sure"]) == ("it was refused: glare", "on", False)
    body = {"by": "alice", "verdict": "right", "reason": "seen"}
    assert client.post(f"/v1/review/{waiting}", json={**body, "verdict": "maybe"}).status_code == 422
    answer = client.post(f"/v1/review/{waiting}", json=body).json()
    assert (answer["state"], answer["final_state"]) == (None, "on")
    assert client.post(f"/v1/review/{waiting}", json=body).status_code == 409
    assert client.post("/v1/review/999999", json=body).status_code == 404


def test_the_command_lists_pictures_and_answers(served: Panelwright, waiting: int, tmp_path: Path) -> None:
    def run(*words: str) -> str:
        done = CliRunner().invoke(_app(), ["review", *words, "--url", served.url])
        assert done.exit_code == 0, (done.output, done.exception)
        return done.output

    assert "glare" in run("--pictures", str(tmp_path))
    assert (tmp_path / f"{waiting}-pump_lamp.png").read_bytes() == b"\x89PNG a lamp"
    told = run("answer", str(waiting), "wrong", "--state", "off", "--reason", "seen", "--by", "alice")
    assert told == f"reading {waiting} is answered: wrong\n"


def test_an_answered_reading_teaches_its_look_over_http_and_on_the_command_line(
    served: Panelwright, client: httpx2.Client, waiting: int
) -> None:
    history = served.service.plant.history
    crop = str(history.row(waiting).reading.crop)

    def teach() -> httpx2.Response:
        return client.post(f"/v1/review/{waiting}/teach")

    assert (teach().status_code, "nobody has said" in teach().json()["detail"]) == (409, True)
    client.post(f"/v1/review/{waiting}", json={"by": "alice", "verdict": "right", "reason": "seen"})
    assert (teach().status_code, "no picture is kept" in teach().json()["detail"]) == (409, True)
    history.crops.add_surroundings(crop, around("emergency"))
    taught = teach().json()
    assert (taught["name"], taught["added"], Path(taught["path"]).name) == ("lamp", True, "lamp.toml")
    told = CliRunner().invoke(_app(), ["review", "teach", str(waiting), "--url", served.url])
    assert told.output == "this look of lamp is known already\n"
    assert client.post("/v1/review/999999/teach").status_code == 404


def test_an_answer_that_nobody_can_tell_teaches_nothing(client: httpx2.Client, waiting: int) -> None:
    client.post(f"/v1/review/{waiting}", json={"by": "alice", "verdict": "unreadable", "reason": "blurred"})
    assert client.post(f"/v1/review/{waiting}/teach").status_code == 409
