"""Tests of limits that people set while the service runs: kept durably, judged at once, refused where they cannot be meant."""

from __future__ import annotations

import json
from pathlib import Path

import httpx2
import pytest

from hal.errors import InvalidRequest
from hal.panel import Panel
from hal.panel.limits import Limits
from service.alarms.lifecycle import State
from service.alarms.limit_book import LimitBook, with_limits
from service.errors import HistoryError
from service.history.reading import VALID, StoredReading
from service.serve import Panelwright
from tests.service.alarms.test_desk import Rig

NO_NUMBER = '{"limits": {"pressure": {"high": "x", "set_s": 1, "by": null}}}'


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return Rig(tmp_path, limits={"high": 6.0})


def limits_of(panel: Panel, name: str) -> Limits | None:
    return panel.object(name).limits


def test_limits_that_were_set_outlive_the_service_and_are_taken_back(tmp_path: Path, rig: Rig) -> None:
    book = LimitBook(tmp_path / "limits.json")
    book.put("pressure", Limits(low=1.0, high=4.0))
    again = LimitBook(tmp_path / "limits.json")
    assert limits_of(again.applied(rig.panel), "pressure") == Limits(low=1.0, high=4.0)
    assert again.all()["pressure"].by is None
    again.put("pressure", None)
    assert limits_of(LimitBook(tmp_path / "limits.json").applied(rig.panel), "pressure") == Limits(high=6.0)


@pytest.mark.parametrize("text", ["", "[]", '{"schema": 2, "limits": {}}', NO_NUMBER])
def test_a_damaged_file_of_limits_is_refused_and_not_changed(tmp_path: Path, text: str) -> None:
    path = tmp_path / "limits.json"
    path.write_text(text)
    with pytest.raises(HistoryError, match=r"cannot be used"):
        LimitBook(path)
    assert path.read_text() == text


def test_limits_of_an_object_that_shows_states_now_are_left_out(tmp_path: Path, rig: Rig) -> None:
    told = {"pump": {"high": 4.0, "set_s": 1.0, "by": "alice"}}
    (tmp_path / "limits.json").write_text(json.dumps({"schema": 1, "limits": told}))
    assert LimitBook(tmp_path / "limits.json").applied(rig.panel) == rig.panel
    with pytest.raises(InvalidRequest, match="a lamp shows no value"):
        with_limits(rig.panel.object("pump"), Limits(high=1.0))


def test_the_newest_reading_is_judged_by_new_limits_at_once(rig: Rig) -> None:
    newest = StoredReading(object="pressure", kind="gauge", utc_s=rig.now_s, cell_s=1.0, quality=VALID, value=5.0)
    rig.desk.redefine(with_limits(rig.panel.object("pressure"), Limits(high=4.0)), newest)
    assert rig.desk.get("pressure.high").state is State.UNACKNOWLEDGED
    assert rig.desk.get("pressure.high").says == "pressure shows 5 bar, above high 4"
    assert [one.object for one in rig.desk.all()] == ["pressure", "pressure", "pump", "pump"]
    rig.desk.redefine(with_limits(rig.panel.object("pressure"), Limits(low=1.0)), newest)
    assert {one.id for one in rig.desk.all()} == {"pressure.low", "pressure.refused", "pump.state", "pump.refused"}
    assert (rig.journal[-1]["kind"], rig.journal[-1]["reason"]) == ("high", "its limit was taken away")
    assert not rig.desk.get("pressure.low").is_active


def test_limits_are_refused_where_no_value_is_shown(client: httpx2.Client, served: Panelwright) -> None:
    refused = client.put("/v1/limits/pump_lamp", json={"high": 1.0})
    assert (refused.status_code, refused.json()["detail"]) == (422, "a lamp shows no value")
    assert client.put("/v1/limits/nothing", json={"high": 1.0}).status_code == 404
    assert client.put("/v1/limits/pump_lamp", json={"high": 1.0, "low": 2.0}).status_code == 422
    assert client.delete("/v1/limits/pump_lamp").status_code == 204
    assert served.service.journal.records(kinds=("limits-set",))[-1].data == {"object": "pump_lamp", "limits": None}
    assert client.get("/v1/limits").json() == {"limits": []}
