"""Tests of what the console shows, without a browser: texts, values, drawing, set-up, arm, and who may ask."""

from __future__ import annotations

import ast
import json
import math
import re
from dataclasses import asdict
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.panel import NumberGoal, Panel, load_panel
from hal.panel.limits import Limits
from manipulation import Kinematics
from service.console.cell_scene import along_y, joint_frames
from service.console.comparison import change_of, earlier
from service.console.devices_page import shown_value
from service.console.history_page import fits
from service.console.mirror import Mirror
from service.console.mission_words import did, step_list
from service.console.missions_page import plan_table
from service.console.object_facts import alarm_line, certified, history_html
from service.console.own_page import is_own
from service.console.panel_drawing import overlay_svg, panel_svg
from service.console.range_points import points_of
from service.console.relay import PICTURES
from service.console.service_client import ServiceClient
from service.console.setup_page import checks
from service.console.texts import ENGLISH
from service.console.trend_chart import of_buckets, of_readings, options_of
from service.console.values import limits_for_people, shown, sigma, target_for_api
from service.jsonable import jsonable
from service.schema.mission_file import MissionFile
from tests.manipulation.arms import T3

ROOT = Path(__file__).parents[3]
LENS = CameraIntrinsics(width_px=640, height_px=480, fx_px=460.0, fy_px=460.0, cx_px=319.5, cy_px=239.5)


@pytest.fixture(scope="module")
def panel() -> Panel:
    return load_panel(ROOT / "panels" / "bench.toml")


def reading(name: str, **given: Any) -> dict[str, Any]:
    """Return a reading as `GET /v1/history` gives it."""
    plain = {"value": None, "unit": "", "sigma": None, "state": None, "text": None, "confidence": 0.95, "cause": ""}
    return {"object": name, "quality": "valid", "utc_s": 1e9, "crop_url": None, **plain, **given}


def test_every_text_is_used_and_every_text_that_is_used_exists() -> None:
    told = ""
    for file in sorted((ROOT / "service/console").glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        told += "\n" + "\n".join(
            node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)
        )
        for node in ast.walk(tree):
            if (
                isinstance(node, ast.Call)
                and getattr(node.func, "id", "") == "say"
                and isinstance(node.args[0], ast.Constant)
            ):
                assert node.args[0].value in ENGLISH, f"{file.name} says {node.args[0].value!r}"
    groups = "editor.kind editor.on_failure editor.is editor.move editor.number compare.against"
    groups += " nav mode state verb column stop step did plan.station alarm limits alarms.do alarms.ask alarms.confirm object.ask"
    built = tuple(
        f"{group}." for group in f"{groups} history.span history.outcome role weekday run".split()
    )  # keys that are put together
    unused = [key for key in ENGLISH if not key.startswith(built) and not re.search(rf"(?m)^{re.escape(key)}$", told)]
    assert unused == []


def test_values_are_in_the_terms_of_their_object(panel: Panel) -> None:
    pressure, bypass = panel.object("pressure"), panel.object("bypass")
    assert shown(pressure, reading("pressure", value=0.67548, unit="bar", sigma=0.018)) == "0.68 bar"
    assert sigma(pressure, reading("pressure", value=0.67548, unit="bar", sigma=0.018)) == "± 0.018"
    assert (
        shown(panel.object("temperature"), reading("temperature", value=159.3, text=" 159.3", unit="degC"))
        == "159.3 °C"
    )
    assert shown(bypass, reading("bypass", value=math.pi / 2, unit="rad")) == "90°"
    assert shown(panel.object("main_valve"), reading("main_valve", value=0.0, state="open")) == "open"
    refused = reading("pressure", value=None, quality="invalid", cause="glare")
    assert shown(pressure, refused) == "not readable", "no value of a refused reading may be seen"
    assert shown(pressure, None) == "not read yet"


def test_a_reading_tells_whether_it_is_sure_and_how_often_such_readings_are_wrong() -> None:
    told = {"at_most": 0.0099, "assurance": 0.95, "cases": 299, "wrong": 0, "source": "simulation", "none": None}
    sure = reading("pressure", sure=True, certificate=told)
    assert certified(sure).startswith(
        "Sure. Of sure readings of this kind here at most 0.99 % are wrong (95 % assurance; 299"
    )
    bare = reading("pressure", sure=True, certificate={"none": "no gauge was judged"})
    assert certified(bare) == "Sure, without a certificate: no gauge was judged."
    assert certified(reading("pressure", sure=False, doubt="it is weak", certificate=None)) == "Not sure: it is weak."


@pytest.mark.parametrize(
    ("given", "look", "told"),
    [
        ({"state": "unacknowledged", "is_active": True}, "bad", "Alarm: too high. Close it"),
        ({"state": "returned-unacknowledged"}, "warn", "Over, but not acknowledged: too high"),
        ({"state": "out-of-service", "is_active": True}, "quiet", "Alarm out of service: too high"),
        ({"state": "shelved"}, "quiet", "Alarm shelved: the condition holds no more"),
    ],
)
def test_an_alarm_calls_only_while_it_is_in_service(given: dict[str, Any], look: str, told: str) -> None:
    alarm = {"is_active": False, "says": "too high", "what_to_do": "close it", "shelved_until_s": None, **given}
    assert alarm_line(alarm) == (look, told)


def test_a_target_in_degrees_reaches_the_api_in_radians_and_within_its_limits(panel: Panel) -> None:
    goal = panel.object("bypass").goal
    assert isinstance(goal, NumberGoal)
    low, high, unit = limits_for_people(goal)
    assert (low, high, unit) == (-360, 360, "°")
    assert target_for_api(goal, 90.0) == pytest.approx(math.pi / 2)
    goal.checked("bypass", target_for_api(goal, high))
    tight = NumberGoal(key="angle_rad", low=0.0, high=6.28, unit="rad", tolerance=0.1)
    assert target_for_api(tight, limits_for_people(tight)[1]) == 6.28, "whole degrees may lie a little beyond the stop"


def test_the_drawing_has_every_object_once_at_its_place_with_its_value(panel: Panel) -> None:
    readings = {
        "pressure": reading("pressure", value=5.0, unit="bar", sigma=0.01),
        "flow": reading("flow", quality="invalid"),
    }
    drawn = ElementTree.fromstring(panel_svg(panel, readings, {}))  # noqa: S314 - made here
    objects = {one.get("data-object"): one for one in drawn if one.get("data-object")}
    assert sorted(objects) == sorted(one.name for one in panel.objects)
    assert "5.00 bar" in (objects["pressure"].get("aria-label") or "")
    assert "not readable" in (objects["flow"].get("aria-label") or "")
    x, y = (float(v) for v in re.findall(r"-?[\d.]+", objects["pressure"].get("transform") or ""))
    assert x / y == pytest.approx(-0.205 / -0.118, rel=1e-3), "y is down in a drawing"
    needle = objects["pressure"].find("line")
    assert needle is not None
    assert float(needle.get("x2", "9")) == pytest.approx(0.0, abs=1e-6), "the middle of this scale is straight up"
    assert float(needle.get("y2", "9")) < 0
    assert objects["flow"].find("line") is None, "a refused reading has no needle"


def test_a_value_that_looks_like_a_script_is_only_text(panel: Panel) -> None:
    drawn = panel_svg(panel, {"mode": reading("mode", state='<script>"')}, {})
    assert "<script" not in drawn
    assert "<script" not in history_html(panel.object("mode"), [reading("mode", state="<script>")])


def test_the_outlines_lie_where_the_lens_sees_the_objects(panel: Panel) -> None:
    pose = RigidTransform.from_components([0.03, -0.02, 0.8], Rotation.from_euler("xyz", [math.pi + 0.1, 0.05, 0.2]))
    drawn = ElementTree.fromstring(overlay_svg(panel, pose, LENS, {}))  # noqa: S314 - made here
    one = next(item for item in drawn if item.get("data-object") == "start")
    polygon = one.find("polygon")
    assert polygon is not None
    points = np.array([pair.split(",") for pair in polygon.get("points", "").split()], float)
    middle = project(pose.apply([[*panel.object("start").position_m, 0.0]]), LENS)[0]
    assert np.abs(points.mean(axis=0) - middle).max() < 0.5
    behind = RigidTransform.from_components([0.0, 0.0, -0.8], Rotation.identity())
    assert "polygon" not in overlay_svg(panel, behind, LENS, {}), "a panel behind the camera is not drawn"


def test_the_drawn_arm_is_the_arm_that_plans() -> None:
    arm = T3
    told = jsonable(asdict(arm))
    q_rad = np.array([0.3, 0.8, -0.9, 0.4, 1.1, -0.2])
    flange = joint_frames(told["links"], q_rad.tolist())[-1]
    assert np.allclose(flange, Kinematics.of(arm).flange(q_rad).as_matrix(), atol=1e-9)


@pytest.mark.parametrize("direction", [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.6, -0.8, 0.0), (2 / 3, 1 / 3, -2 / 3)])
def test_a_rod_is_turned_from_y_into_its_direction(direction: tuple[float, float, float]) -> None:
    turn = np.array(along_y(np.array(direction)))
    assert np.allclose(turn @ [0.0, 1.0, 0.0], direction, atol=1e-9)
    assert np.allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.isclose(np.linalg.det(turn), 1.0)


@pytest.mark.parametrize("projection", ["pinhole", "orthographic", "polar"])
def test_the_points_of_a_range_image_lie_where_the_scanner_measured_them(projection: Any) -> None:
    plain = {"fx": 50.0, "fy": 40.0, "cx": 3.0, "cy": 0.5, "first_angle_rad": -0.4, "step_angle_rad": 0.1}
    shape = {"width": 9, "height": 1 if projection == "polar" else 2}
    depth = np.full((shape["height"], 9), np.nan, np.float32)
    depth[-1, 2], depth[0, 8] = 0.5, 0.25
    found = points_of(depth, {"projection": projection, **plain, **shape})
    if projection == "polar":
        turned = [Rotation.from_euler("y", -0.4 + 0.1 * k).apply([0.0, 0.0, z]) for k, z in ((2, 0.5), (8, 0.25))]
        assert np.allclose(found, turned)
        return
    lens = np.array([[50.0, 0.0, 3.0], [0.0, 40.0, 0.5], [0.0, 0.0, 1.0]])
    flat = found / found[:, 2:] if projection == "pinhole" else np.column_stack([found[:, :2], np.ones(2)])
    assert np.allclose(lens @ flat.T, np.array([[8.0, 0.0, 1.0], [2.0, 1.0, 1.0]]).T)
    assert np.allclose(found[:, 2], [0.25, 0.5])
    many = points_of(np.ones((400, 400), np.float32), {"projection": projection, **plain, "width": 400, "height": 400})
    assert 5000 < len(many) <= 6000


@pytest.mark.parametrize(
    ("headers", "is_allowed"),
    [
        ({"host": "127.0.0.1:8462"}, True),
        ({"host": "localhost:9000", "origin": "http://localhost:9000"}, True),  # through ssh -L
        ({"host": "[::1]:8462"}, True),
        ({"host": "evil.example:8462"}, False),  # DNS rebinding
        ({"host": "127.0.0.1:8462", "origin": "http://evil.example"}, False),
        ({"host": "127.0.0.1:8462", "origin": "null"}, False),
        ({"host": "127.0.0.1:8462", "sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}, False),
        ({"host": "127.0.0.1:8462", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"}, True),  # a link
        ({}, False),
    ],
)
def test_only_the_own_page_may_use_the_console(headers: dict[str, str], is_allowed: bool) -> None:
    assert is_own(headers) is is_allowed


@pytest.mark.parametrize(
    ("path", "is_passed"),
    [
        ("/v1/devices/wrist_camera/reading", True),
        (f"/v1/history/pressure/crops/{'a' * 64}", True),
        ("/v1/missions/20261123T081014-7c/report.html", True),
        ("/v1/stop/reset", False),
        ("/v1/lease", False),
        ("/v1/missions/../lease", False),
        ("/v1/devices/arm/reading?format=npz", False),
    ],
)
def test_the_relay_passes_on_pictures_and_reports_only(path: str, is_passed: bool) -> None:
    assert (PICTURES.fullmatch(path) is not None) is is_passed


def test_missions_are_told_in_plain_words(panel: Panel) -> None:
    closed = {"object": "main_valve", "state": "closed"}
    then = {"kind": "set", "name": "turn", "object": "setpoint", "value": 40.0, "on_failure": "skip"}
    steps = [
        {"kind": "inspect", "name": "a", "objects": ["pressure", "setpoint"]},
        {
            "kind": "choose",
            "name": "b",
            "when": [closed, {"object": "pressure", "above": 1.0, "below": 2.0}],
            "then": [then],
        },
        {"kind": "wait_until", "name": "c", "conditions": [closed], "timeout_s": 600.0},
    ]
    mission = MissionFile.model_validate_json(json.dumps({"schema": 1, "steps": steps}))
    told = step_list(mission.model_dump(mode="json", exclude_none=True)["steps"], panel)
    assert "Reads PRESSURE and SETPOINT from close up." in told
    assert (
        "If MAIN VALVE shows closed and PRESSURE is between 1 and 2:<ol><li>Sets SETPOINT to 40. If that fails" in told
    )
    assert "Waits until MAIN VALVE shows closed, at most 10 min." in told
    assert did("close-up", "pressure, flow", panel) == "Reads from close up: PRESSURE, FLOW"
    assert did("lever main_valve: attempt 1", "", panel) == "Lever MAIN VALVE: attempt 1"
    assert did("step read", "", None) == "Step read begins"


def test_an_unreachable_station_is_told_in_the_plan(panel: Panel) -> None:
    stations = [{"step": "read", "what": "overview", "way_s": None, "problem": "the floor is in the way"}]
    plan = {"stations": stations, "is_possible": False, "located": False, "ways_s": 0, "contact_s": 0, "expected_s": 0}
    told = plan_table("demo", plan, panel)
    assert "the mission would fail there" in told
    assert '<a href="/cell">See this way in 3-D</a>' in told
    assert '<td class="bad">the floor is in the way</td>' in told


def test_values_of_devices_have_units_and_names() -> None:
    assert shown_value("proximity", 0.47931) == "0.479 m"
    assert shown_value("touch", [False, True]) == "left free, right touched"
    assert shown_value("proximity", None) == "nothing in its range"
    assert shown_value("lights", [True, False]) == "lights on off"
    assert shown_value("gripper", {"width_m": 0.04, "is_moving": False}) == "width 0.04 m, moving no"
    assert shown_value("force_torque", {"force_n": [1.0, 2.5, 0.0]}) == "force 1 2.5 0 N"


def test_a_change_is_sure_only_beyond_both_uncertainties(panel: Panel) -> None:
    gauge, valve = panel.object("pressure"), panel.object("main_valve")
    newest = reading("pressure", unit="bar", value=4.0, sigma=0.1, utc_s=20.0)
    assert change_of(gauge, newest, reading("pressure", unit="bar", value=3.8, sigma=0.1, utc_s=10.0)) == (
        False,
        "+0.2 bar",
    )
    assert change_of(gauge, newest, reading("pressure", unit="bar", value=4.4, sigma=0.1, utc_s=10.0)) == (
        True,
        "−0.4 bar",
    )
    refused = reading("pressure", quality="invalid", cause="glare", utc_s=10.0)
    assert change_of(gauge, newest, refused) == (False, "cannot be told")
    assert change_of(gauge, refused, refused) == (False, "cannot be told")
    assert change_of(gauge, newest, None) == (False, "–")
    states = [reading("main_valve", state=state, utc_s=10.0) for state in ("open", "open", "closed")]
    assert change_of(valve, states[0], states[1]) == (False, "the same")
    assert change_of(valve, states[0], states[2]) == (True, "changed")


def test_last_time_is_the_task_before_however_often_one_task_reads() -> None:
    rows = [{"id": k, "task": task} for k, task in enumerate(["a", "b", "b", "c", "c"])]
    assert earlier(rows[-1], rows) == rows[2]
    assert earlier(rows[0], rows) is None


def test_a_trend_has_its_band_in_the_words_of_the_object_and_no_refused_reading(panel: Panel) -> None:
    limited = panel.object("pressure").model_copy(update={"limits": Limits(low=1.0, high=6.0, high_high=8.0)})
    readings = [
        reading("pressure", value=4.0, sigma=0.5, utc_s=10.0),
        reading("pressure", quality="invalid", cause="glare", utc_s=11.0),
        reading(
            "pressure", value=5.0, sigma=None, utc_s=12.0004
        ),  # ECharts would not draw the fraction of a millisecond
    ]
    bypass = of_readings(panel.object("bypass"), [reading("bypass", value=math.pi / 2, utc_s=10.0)])
    chart = options_of([of_readings(limited, readings), bypass])
    lower, band, line = chart["series"][:3]
    assert line["data"] == [[10_000, 4.0], [12_000, 5.0]]
    assert lower["data"][0][1] == pytest.approx(4.0 - 1.96 * 0.5)
    assert band["data"][0][1] == pytest.approx(2 * 1.96 * 0.5)
    assert [mark["yAxis"] for mark in line["markLine"]["data"]] == [1.0, 6.0, 8.0]
    assert [axis["name"] for axis in chart["yAxis"]] == ["bar", "°"]
    assert chart["yAxis"][0]["min"] < 1.0
    assert 6.0 < chart["yAxis"][0]["max"] < 8.0, "the axis reaches the nearest limits, and no others"
    assert chart["series"][5]["yAxisIndex"] == 1
    assert chart["series"][5]["data"] == [[10_000.0, 90.0]]


def test_a_span_of_time_is_a_point_from_its_least_to_its_greatest_value(panel: Panel) -> None:
    span = {"since_s": 0.0, "until_s": 10.0, "minimum": 1.0, "mean": 2.0, "maximum": 4.0}
    trend = of_buckets(panel.object("pressure"), [span, {**span, "minimum": None, "mean": None, "maximum": None}])
    assert [(one.at_s, one.low, one.value, one.high) for one in trend.points] == [(5.0, 1.0, 2.0, 4.0)]


@pytest.mark.parametrize(
    ("asked", "is_found"),
    [
        ({}, True),
        ({"wanted": "PRESS"}, True),
        ({"wanted": "druck"}, True),
        ({"wanted": "flow"}, False),
        ({"outcome": "failed"}, True),
        ({"outcome": "succeeded"}, False),
        ({"since": "2026-01-04"}, False),
        ({"since": "2026-01-01", "until": "2026-01-05"}, True),
        ({"until": "2026-01-01"}, False),
    ],
)
def test_reports_are_found_by_object_outcome_and_day(asked: dict[str, str], is_found: bool) -> None:
    mission = {"objects": ["pressure"], "succeeded": False, "started": "2026-01-03T12:00:00Z"}
    usual = {"wanted": "", "outcome": "any", "since": "", "until": ""}
    assert fits(mission, labels={"pressure": "Druck"}, **{**usual, **asked}) is is_found


def test_the_set_up_names_what_is_missing_and_the_one_next_step() -> None:
    mirror = Mirror(ServiceClient("http://127.0.0.1:1"))
    assert next(checks(mirror)).fix, "before the service answers, its start is the next step"
    lost = {"device": "arm", "why": "no answer", "hint": "plug it in", "lost": ["missions"]}
    mirror._said = {
        "ready": {"is_running": True, "missing": [lost], "processes": []},
        "stop": {"is_latched": True},
        "frames": {"frames": [{"child": "panel"}]},
        "missions": {"missions": [{}]},
    }
    missing = [check for check in checks(mirror) if check.fix]
    assert [check.path for check in missing] == ["/v1/devices/arm/connect", ""]
    assert missing[0].fix == "arm: plug it in"
    mirror._said |= {"ready": {"is_running": True, "missing": [], "processes": []}, "stop": {"is_latched": False}}
    assert [check.fix for check in checks(mirror) if check.fix] == []
