"""Tests of the history over HTTP and on the command line, and of what a task writes into it."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from typer.testing import CliRunner

from hal.config import load_cell
from perception.vision import ObjectReading
from perception.vision.reading import Guess, Possible
from service.cli import _app
from service.history.observer import Observations
from service.history.parts import read_parts
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.history.test_store import NOW_S, history_in, reading
from tests.service.verbs import OPERATIONS

CROP = b"\x89PNG of a gauge"


@pytest.fixture(scope="module")
def filled(served: Panelwright) -> Iterator[Panelwright]:
    """Yield a service whose history has ten readings of a gauge, two of them refused."""
    crop = served.service.plant.history.crops.add(CROP)
    readings = [reading(k, None if k in (3, 7) else float(k), crop=crop, asked_by="a, b") for k in range(10)]
    served.service.plant.history.add(readings)
    yield served


def test_a_page_leads_to_the_next_one(filled: Panelwright, client: httpx2.Client) -> None:
    path, after, values = "/v1/history/pressure?limit=4", 0, []
    while after is not None:
        page = client.get(f"{path}&after={after}").json()
        values += [row["value"] for row in page["readings"]]
        after = page["next_after"]
    assert values == [None if k in (3, 7) else float(k) for k in range(10)]
    first = client.get(path).json()["readings"][0]
    assert (first["quality"], first["unit"], first["asked_by"]) == ("valid", "bar", "a, b")
    picture = client.get(first["crop_url"])
    assert (picture.content, picture.headers["content-type"]) == (CROP, "image/png")
    assert client.get(first["crop_url"].replace("/crops/", "/crops/0")[:-1]).status_code == 404


def test_a_reading_says_whether_it_is_sure_and_what_its_certificate_bounds(
    served: Panelwright, client: httpx2.Client
) -> None:
    said = {"at_most": 0.01, "assurance": 0.95, "cases": 299, "wrong": 0, "source": "simulation", "id": "a1"}
    readings = [
        reading(0, 1.0, object="certified", certificate=json.dumps(said)),
        reading(1, 2.0, object="certified", certificate=json.dumps({"none": "it is not sure"}), doubt="it is weak"),
    ]
    served.service.plant.history.add(readings)
    sure, weak = client.get("/v1/history/certified").json()["readings"]
    assert (sure["sure"], sure["certificate"]) == (True, {**said, "none": None})
    assert (weak["sure"], weak["certificate"]["none"], weak["certificate"]["at_most"]) == (
        False,
        "it is not sure",
        None,
    )


def test_a_trend_is_down_sampled_and_counts_what_was_refused(filled: Panelwright, client: httpx2.Client) -> None:
    query = f"since_s={NOW_S}&until_s={NOW_S + 10}&buckets=2"
    one, two = client.get(f"/v1/history/pressure?{query}").json()["buckets"]
    assert (one["count"], one["refused"], one["minimum"], one["maximum"], one["mean"]) == (5, 1, 0.0, 4.0, 1.75)
    assert (two["count"], two["refused"], two["mean"]) == (5, 1, 7.0)
    assert client.get("/v1/history/flow?buckets=9").json()["buckets"] == []


def test_the_export_is_the_same_in_both_formats(filled: Panelwright, client: httpx2.Client, tmp_path: Path) -> None:
    text = client.get("/v1/history/export?object=pressure").text
    rows = list(csv.DictReader(io.StringIO(text)))
    assert [row["value"] for row in rows[:4]] == ["0.0", "1.0", "2.0", ""]
    assert (rows[0]["asked_by"], rows[3]["cause"]) == ("a, b", "glare")
    file = tmp_path / "history.parquet"
    file.write_bytes(client.get("/v1/history/export?object=pressure&format=parquet").content)
    same = read_parts([file], "id, utc_s, value, cause", "ORDER BY id", [])
    assert same == [
        (int(r["id"]), float(r["utc_s"]), float(r["value"]) if r["value"] else None, r["cause"]) for r in rows
    ]


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/v1/history/Pressure", 422),
        ("/v1/history/pressure?since_s=nan", 422),
        ("/v1/history/pressure?since_s=5&until_s=4", 422),
        ("/v1/history/pressure?buckets=2001", 422),
        ("/v1/history/pressure?since=5", 422),
        ("/v1/history/pressure/crops/..%2fhistory.sqlite", 404),
    ],
)
def test_a_question_that_cannot_be_meant_is_refused(client: httpx2.Client, path: str, status: int) -> None:
    assert client.get(path).status_code == status


def test_the_command_shows_writes_and_draws(filled: Panelwright, tmp_path: Path) -> None:
    table, picture = tmp_path / "p.csv", tmp_path / "p.png"
    said = CliRunner().invoke(
        _app(),
        ["history", "pressure", "--since", "5000w", "--url", filled.url, "--csv", str(table), "--plot", str(picture)],
    )
    assert said.exit_code == 0, said.output
    assert "refused: glare" in said.output
    assert table.read_text().count("\n") == 11
    assert picture.read_bytes().startswith(b"\x89PNG")


def seen(name: str, **given: Any) -> ObjectReading:
    """Return a reading as a look gives it."""
    nothing = np.zeros((0, 2))
    plain = {"kind": "gauge", "present": True, "centre_px": np.zeros(2), "outline_px": nothing}
    return ObjectReading(name=name, **{**plain, **given})


def test_a_task_stores_everything_that_is_known_about_a_reading(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    kept = Observations(history=history)
    heard: list[Any] = []
    kept.listeners.append(heard.extend)
    observer = kept.of_task(task="t1", verb="missions", asked_by="alice", cell_now_s=lambda: 12.5)
    observer.told("pressure", "open")
    good = seen("pressure", value=3.2, unit="bar", uncertainty=0.1, confidence=0.9)
    doubtful = seen(
        "temperature",
        reason="glare",
        guess=Guess(text="18.0"),
        possible=(Possible(text="16.0", value=16.0, probability=0.4),),
    )
    observer.saw([good, doubtful, seen("gone", present=False)], {"pressure": CROP}, mission="m", phase="before")
    a, b, c = (row.reading for row in history.reader().page(history.ask()))
    assert (a.value, a.sigma, a.told, a.cell_s, a.mission, a.task) == (3.2, 0.1, "open", 12.5, "m", "t1")
    assert history.crops.path(str(a.crop)) is not None
    assert (b.quality, b.value, b.cause) == ("invalid", None, "glare")
    assert b.guess is not None and '"18.0"' in b.guess and '"16.0"' in b.guess
    assert (c.quality, c.cause) == ("invalid", "it is not where the panel file says")
    assert [one.object for one in heard] == ["pressure", "temperature", "gone"]
    assert Observations(history=history).targets == {"pressure": "open"}
    assert (observer.asked_by, sorted(observer.newest())) == ("alice", ["gone", "pressure", "temperature"])


def test_the_surroundings_of_doubted_readings_are_kept(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    kept = Observations(history=history, doubt_of=lambda one: "" if one.is_valid else "it was refused")
    observer = kept.of_task(task="t1", verb="inspect", asked_by="", cell_now_s=lambda: 0.0)
    names = ("pressure", "flow", "far")
    crops = {name: name.encode() for name in names}
    around = {"pressure": b"around pressure", "flow": b"around flow"}
    observer.saw(
        [seen("pressure", value=1.0), seen("flow", reason="glare"), seen("far", reason="x")], crops, around.get
    )
    sure, doubted, without = (str(row.reading.crop) for row in history.reader().page(history.ask()))
    assert history.crops.surroundings(doubted) == b"around flow"
    assert (history.crops.surroundings(sure), history.crops.surroundings(without)) == (None, None)
    assert history.crops.surroundings("../../x") is None


def test_a_reading_that_cannot_be_stored_is_not_passed_on(tmp_path: Path) -> None:
    history = history_in(tmp_path)
    kept = Observations(history=history)
    heard: list[Any] = []
    kept.listeners.append(heard.extend)
    observer = kept.of_task(task="t1", verb="inspect", asked_by="", cell_now_s=lambda: 0.0)
    history._db.execute("PRAGMA query_only=1")
    from service.errors import HistoryError

    with pytest.raises(HistoryError, match="cannot be written"):
        observer.saw([seen("pressure", value=1.0)], {})
    assert heard == []


def test_the_service_comes_up_with_a_damaged_history_and_names_it(write_cell: WriteCell, tmp_path: Path) -> None:
    folder = tmp_path / "runs" / ".service" / "history"
    folder.mkdir(parents=True)
    (folder / "history.sqlite").write_bytes(b"not a database" * 100)
    cell = load_cell(write_cell(robot=True))
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True)
    panelwright = Panelwright(cell, options, operations=OPERATIONS)
    (aside,) = panelwright.service.plant.history.set_aside
    panelwright.service.plant.history.add([replace(reading(0), object="pump_lamp")])
    panelwright.service.close()  # which waits for the journal
    records = panelwright.service.journal.records(kinds=("history-set-aside",))
    assert [record.data["file"] for record in records] == [str(aside)]
