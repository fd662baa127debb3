"""Tests of the HTTP API with a cell of fakes: a real server and socket, all the way down to the devices."""

from __future__ import annotations

import io
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx2
import numpy as np
import pytest
from PIL import Image as Picture

from perception.range.recordings import AS_FILED, assumptions, load_recording
from perception.range.sensor import PinholeSensor
from service.serve import Panelwright
from tests.service.waiting import eventually


def test_a_verb_that_ends_in_time_answers_200_with_its_result(client: httpx2.Client) -> None:
    answer = client.post("/v1/echo?wait_s=10", json={"text": "a", "point_m": [1, 2, 3]})
    assert answer.status_code == 200
    task = answer.json()
    assert task["state"] == "succeeded"
    assert task["result"] == {"text": "a", "number": 1.0, "nothing": None}
    assert client.get(task["artefacts"][0]["url"]).text == "a"


def test_a_request_that_makes_no_sense_here_never_becomes_a_task(client: httpx2.Client) -> None:
    before = len(client.get("/v1/tasks").json()["tasks"])
    answer = client.post("/v1/echo", json={"text": "SHOUT"})
    assert (answer.status_code, answer.json()["hint"]) == (422, "lower the voice")
    assert len(client.get("/v1/tasks").json()["tasks"]) == before


def test_an_unknown_key_is_answered_with_the_nearest_known_one(client: httpx2.Client) -> None:
    problem = client.post("/v1/echo", json={"nubmer": 3.0}).json()
    assert problem["detail"] == "body.nubmer: unknown key"
    assert problem["hint"] == "did you mean 'number'?"


def test_a_verb_that_takes_longer_answers_202_and_says_where_to_look(client: httpx2.Client) -> None:
    answer = client.post("/v1/wait", json={})
    assert answer.status_code == 202
    where = answer.headers["location"]
    assert client.get(where).json()["state"] in ("queued", "running")
    cancelled = client.post(f"{where}/cancel?wait_s=10").json()
    assert cancelled["state"] == "cancelled"
    assert cancelled["problem"]["type"] == "urn:panelwright:cancelled"


def test_a_failed_verb_answers_with_the_problem_that_names_the_device(client: httpx2.Client) -> None:
    answer = client.post("/v1/fail?wait_s=10", json={})
    assert answer.status_code == 504
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["details"] == {"device": "wrist_ft"}
    assert problem["retry"] == "safe"
    assert problem["hint"]
    assert client.get(problem["instance"]).json()["state"] == "failed"


def test_a_defect_in_an_operation_fails_its_task_and_nothing_else(client: httpx2.Client) -> None:
    answer = client.post("/v1/fail?wait_s=10", json={"defect": True})
    assert answer.json()["type"] == "urn:panelwright:defect"
    assert client.get("/healthz").status_code == 200


def test_cancel_stops_a_motion(client: httpx2.Client, served: Panelwright) -> None:
    where = client.post("/v1/hold", json={}).headers["location"]
    eventually(lambda: client.get(where).json()["step"] == "holding")
    assert client.post(f"{where}/cancel?wait_s=10").json()["state"] == "cancelled"
    assert not served.service.supervisor.connection.mover.state().is_moving


def test_cancelling_what_has_ended_is_a_conflict(client: httpx2.Client) -> None:
    task = client.post("/v1/echo?wait_s=10", json={}).json()
    assert client.post(f"/v1/tasks/{task['id']}/cancel").status_code == 409


def test_moving_tasks_wait_for_one_another_and_reading_tasks_for_nobody(client: httpx2.Client) -> None:
    first = client.post("/v1/hold", json={}).headers["location"]
    second = client.post("/v1/hold", json={"seconds": 0.1}).headers["location"]
    assert client.post("/v1/measure?wait_s=10", json={}).json()["result"] == {"distance_m": 0.123}
    assert client.get(second).json()["state"] == "queued"
    client.post(f"{first}/cancel")
    assert client.get(f"{second}?wait_s=20").json()["state"] == "succeeded"


def test_an_idempotency_key_gives_the_same_task_again(client: httpx2.Client) -> None:
    headers = {"Idempotency-Key": f"k-{time.monotonic_ns()}"}
    first = client.post("/v1/echo?wait_s=10", json={"text": "x"}, headers=headers).json()
    again = client.post("/v1/echo?wait_s=10", json={"text": "x"}, headers=headers).json()
    other = client.post("/v1/echo", json={"text": "y"}, headers=headers)
    assert first["id"] == again["id"]
    assert other.status_code == 422


def _events(client: httpx2.Client, url: str, last: int | None = None) -> list[tuple[int, str, dict[str, object]]]:
    headers = {} if last is None else {"Last-Event-ID": str(last)}
    text = client.get(url, headers=headers).text
    blocks = [dict(line.split(": ", 1) for line in block.splitlines()) for block in text.strip().split("\n\n")]
    return [(int(block["id"]), block["event"], json.loads(block["data"])) for block in blocks]


def test_events_tell_the_whole_story_without_gaps(client: httpx2.Client) -> None:
    task = client.post("/v1/echo", json={}).json()
    events = _events(client, task["events_url"])
    assert [number for number, _, _ in events] == list(range(1, len(events) + 1))
    assert [data["step"] for _, kind, data in events if kind == "progress"] == ["listening", "speaking"]
    assert [data["state"] for _, kind, data in events if kind == "state"] == ["queued", "running", "succeeded"]
    assert events[-1][2]["fraction"] == 1.0


def test_events_resume_after_the_last_one_seen(client: httpx2.Client) -> None:
    task = client.post("/v1/echo?wait_s=10", json={}).json()
    everything = _events(client, task["events_url"])
    assert _events(client, task["events_url"], last=3) == everything[3:]


def test_devices_show_their_health(client: httpx2.Client) -> None:
    devices = {device["name"]: device for device in client.get("/v1/devices").json()["devices"]}
    assert devices["wrist_camera"]["kind"] == "camera"
    assert devices["wrist_camera"]["health"]["connected"]
    detail = client.get("/v1/devices/wrist_camera").json()
    assert detail["capabilities"]["width_px"] == 64
    assert detail["mount"] == {"parent": "flange", "calibration": "wrist_camera"}


def test_an_unknown_device_gets_the_nearest_name(client: httpx2.Client) -> None:
    answer = client.get("/v1/devices/wrist_camra/reading")
    assert answer.status_code == 404
    assert "wrist_camera" in answer.json()["hint"]


def test_readings_come_as_json_png_and_npz(client: httpx2.Client) -> None:
    reading = client.get("/v1/devices/finger_proximity/reading").json()
    assert (reading["value"], reading["quality"]) == (0.123, "valid")
    picture = Picture.open(io.BytesIO(client.get("/v1/devices/wrist_camera/reading?format=png").content))
    assert picture.size == (64, 48)
    assert picture.getpixel((63, 0)) == (255, 255, 255)
    depth = np.load(io.BytesIO(client.get("/v1/devices/range_scanner/reading?format=npz").content))["depth_m"]
    assert depth.shape == (12, 16)
    assert np.isnan(depth[0, 0])
    assert client.get("/v1/devices/range_scanner/reading?format=png").headers["content-type"] == "image/png"
    assert client.get("/v1/devices/finger_proximity/reading?format=png").status_code == 422


def test_what_a_scanner_gives_is_a_recording_that_says_which_sensor_took_it(
    client: httpx2.Client, tmp_path: Path
) -> None:
    file = tmp_path / "scan.npz"
    file.write_bytes(client.get("/v1/devices/range_scanner/reading?format=npz").content)
    depth_m, sensor = load_recording(file)
    told = client.get("/v1/devices/range_scanner").json()["capabilities"]
    assert isinstance(sensor, PinholeSensor)
    assert (sensor.fx_px, sensor.fy_px, sensor.cx_px, sensor.cy_px) == tuple(told[k] for k in ("fx", "fy", "cx", "cy"))
    assert depth_m.shape == (sensor.height_px, sensor.width_px) == (12, 16)
    assert np.nanmax(depth_m) == pytest.approx(0.5)
    assert assumptions(file, AS_FILED) == ()


def test_a_young_reading_is_shared_and_an_old_one_is_not(client: httpx2.Client) -> None:
    first = client.get("/v1/devices/finger_proximity/reading").json()["sequence"]
    assert client.get("/v1/devices/finger_proximity/reading?max_age_s=60").json()["sequence"] == first
    assert client.get("/v1/devices/finger_proximity/reading").json()["sequence"] > first


def test_a_reading_that_is_not_a_number_is_null(client: httpx2.Client) -> None:
    client.post("/v1/devices/finger_proximity/fault", json={"fault": "biased"})
    assert client.get("/v1/devices/finger_proximity/reading").json()["value"] is None


def test_an_injected_fault_shows_in_health_reading_and_problem(client: httpx2.Client) -> None:
    assert client.post("/v1/devices/wrist_camera/fault", json={"fault": "silent"}).status_code == 200
    answer = client.get("/v1/devices/wrist_camera/reading")
    assert answer.status_code == 504
    assert answer.json()["details"]["device"] == "wrist_camera"
    shown = client.get("/v1/devices/wrist_camera").json()["health"]
    assert shown["quality"] == "invalid"
    client.post("/v1/devices/wrist_camera/fault", json={"fault": None})
    assert client.get("/v1/devices/wrist_camera/reading").status_code == 200


def test_frames_name_parent_and_child(client: httpx2.Client) -> None:
    frames = {frame["child"]: frame for frame in client.get("/v1/frames").json()["frames"]}
    assert frames["wrist_camera"]["parent"] == "flange"
    assert frames["wrist_camera"]["translation_m"] == [0.0, 0.0, 0.05]
    assert frames["flange"]["source"] == "measured"
    assert len(frames["wrist_camera"]["covariance"]) == 6


def test_the_panel_file_is_readable(client: httpx2.Client) -> None:
    assert client.get("/v1/panel").json()["objects"][0]["name"] == "pump_lamp"


def test_a_lease_keeps_others_from_moving_until_it_is_released(client: httpx2.Client) -> None:
    grant = client.post("/v1/lease", json={"holder": "alice"}).json()
    token = {"Lease-Token": grant["token"]}
    assert client.post("/v1/lease", json={"holder": "bob"}).json()["details"]["holder"] == "alice"
    refused = client.post("/v1/hold", json={"seconds": 0.1})
    assert (refused.status_code, refused.json()["details"]["holder"]) == (409, "alice")
    assert client.post("/v1/measure?wait_s=10", json={}).status_code == 200, "reading needs no lease"
    assert client.post("/v1/hold?wait_s=10", json={"seconds": 0.1}, headers=token).status_code == 200
    assert client.post("/v1/lease/heartbeat", headers=token).status_code == 200
    assert client.post("/v1/lease/release", headers=token).json()["is_held"] is False
    assert client.post("/v1/lease/heartbeat", headers=token).json()["type"] == "urn:panelwright:stale-epoch"


def test_a_holder_may_have_any_name_that_can_be_shown(client: httpx2.Client) -> None:
    grant = client.post("/v1/lease", json={"holder": "Zoë@кухня-2"}).json()
    assert client.get("/v1/lease").json()["holder"] == "Zoë@кухня-2"
    assert client.post("/v1/lease", json={"holder": "bob"}).json()["detail"] == "Zoë@кухня-2 holds the cell"
    assert (
        client.post(
            "/v1/stop/reset",
            json={"seen_count": client.get("/v1/stop").json()["count"]},
            headers={"Lease-Token": grant["token"]},
        ).status_code
        == 200
    )
    client.post("/v1/lease/release", headers={"Lease-Token": grant["token"]})
    for bad in ("two\nlines", "a\u202eb", ""):
        refused = client.post("/v1/lease", json={"holder": bad})
        assert refused.status_code == 422
    assert "printable" in client.post("/v1/lease", json={"holder": "\t"}).json()["detail"]


def test_a_take_over_ends_what_the_old_holder_started(client: httpx2.Client) -> None:
    alice = client.post("/v1/lease", json={"holder": "alice"}).json()
    where = client.post("/v1/hold", json={}, headers={"Lease-Token": alice["token"]}).headers["location"]
    bob = client.post("/v1/lease/take-over", json={"holder": "bob", "reason": "alice has left"}).json()
    assert bob["epoch"] > alice["epoch"]
    task = client.get(f"{where}?wait_s=10").json()
    assert task["state"] == "cancelled"
    assert "bob" in task["problem"]["detail"]
    assert client.post("/v1/hold", json={}, headers={"Lease-Token": alice["token"]}).status_code == 409


def test_who_takes_the_lease_does_not_share_the_arm_with_a_task_that_was_begun_without_one(
    client: httpx2.Client,
) -> None:
    where = client.post("/v1/hold", json={}).headers["location"]
    eventually(lambda: client.get(where).json()["state"] == "running")
    refused = client.post("/v1/lease", json={"holder": "bob"})
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:panelwright:lease-error")
    assert where.rpartition("/")[2] in refused.json()["detail"]
    assert not client.get("/v1/lease").json()["is_held"]
    bob = client.post("/v1/lease/take-over", json={"holder": "bob", "reason": "alice has left"}).json()
    task = client.get(f"{where}?wait_s=10").json()
    assert (task["state"], "bob took the lease over" in task["problem"]["detail"]) == ("cancelled", True)
    again = client.post("/v1/hold", json={}, headers={"Lease-Token": bob["token"]}).headers["location"]
    assert client.post("/v1/lease/release", headers={"Lease-Token": bob["token"]}).status_code == 200
    assert client.post("/v1/lease", json={"holder": "alice"}).status_code == 409, "what bob left behind moves"
    client.post(f"{again}/cancel?wait_s=10")
    alice = client.post("/v1/lease", json={"holder": "alice"}).json()
    assert client.post("/v1/lease/release", headers={"Lease-Token": alice["token"]}).status_code == 200


def test_a_lapsed_lease_ends_the_motion(client: httpx2.Client) -> None:
    alice = client.post("/v1/lease", json={"holder": "alice"}).json()
    where = client.post("/v1/hold", json={}, headers={"Lease-Token": alice["token"]}).headers["location"]
    task = client.get(f"{where}?wait_s=20").json()
    assert task["state"] == "cancelled"
    assert "lapsed" in task["problem"]["detail"]


def test_stop_ends_a_motion_and_nothing_moves_until_reset_and_a_new_command(
    client: httpx2.Client, served: Panelwright
) -> None:
    where = client.post("/v1/hold", json={}).headers["location"]
    eventually(lambda: client.get(where).json()["step"] == "holding")
    stopped = httpx2.post(served.stop_url, trust_env=False).json()
    assert stopped["is_latched"]
    assert client.get(f"{where}?wait_s=10").json()["state"] == "failed"
    refused = client.post("/v1/hold", json={"seconds": 0.1})
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:panelwright:stopped")
    assert client.get("/v1/stop").json()["is_latched"]
    stale = client.post("/v1/stop/reset", json={"seen_count": stopped["count"] - 1})
    assert stale.status_code == 409
    unseen = client.post("/v1/stop/reset", json={})
    assert unseen.status_code == 409, "nobody has seen a stop of this very moment"
    assert "s ago" in unseen.json()["detail"]
    assert client.post("/v1/stop/reset", json={"seen_count": stopped["count"]}).json()["is_latched"] is False
    assert not served.service.supervisor.connection.mover.state().is_moving, "a reset alone moves nothing"
    again = client.post("/v1/stop/reset", json={"seen_count": stopped["count"]})
    assert again.status_code == 409, "a second reset with the same count is one with an old count"
    assert client.post("/v1/hold?wait_s=10", json={"seconds": 0.1}).status_code == 200


@pytest.mark.parametrize("method", ["get", "put", "delete", "patch"])
def test_only_post_stops_at_the_stop_port(client: httpx2.Client, served: Panelwright, method: str) -> None:
    answer = getattr(httpx2, method)(served.stop_url, trust_env=False)
    assert answer.status_code == (200 if method == "get" else 405)
    assert not client.get("/v1/stop").json()["is_latched"]


def test_missions_list_only_finished_reports_and_serve_their_files(client: httpx2.Client, served: Panelwright) -> None:
    folder = served.service.runs_dir / "2026-01-02T03-04-05"
    folder.mkdir(exist_ok=True)
    (folder / "report.html").write_text("<h1>done</h1>")
    assert not any(m["name"] == folder.name for m in client.get("/v1/missions").json()["missions"])
    (folder / "report.json").write_text("{}")
    mission = next(m for m in client.get("/v1/missions").json()["missions"] if m["name"] == folder.name)
    assert "done" in client.get(mission["report_url"]).text
    (folder / "report.json").unlink()


def test_missions_are_sorted_by_when_they_began_not_by_when_their_files_were_touched(
    client: httpx2.Client, served: Panelwright
) -> None:
    days = {"copied-in": 1, "20260103T000000-a": 3, "20260102T000000-b": 2, "damaged": 0}
    for name, day in days.items():
        (folder := served.service.runs_dir / name).mkdir()
        told = {"started": f"2026-01-0{day}T00:00:00Z"} if day else []
        (folder / "report.json").write_text(json.dumps(told))
        os.utime(folder / "report.json", ns=(10**18 - day, 10**18 - day))
    missions = client.get("/v1/missions").json()["missions"]
    assert [m["name"] for m in missions if m["name"] in days] == sorted(days, key=days.__getitem__, reverse=True)
    assert next(m["started"] for m in missions if m["name"] == "copied-in") == "2026-01-01T00:00:00Z"
    for name in days:
        (served.service.runs_dir / name / "report.json").unlink()


def test_info_and_readiness(client: httpx2.Client, served: Panelwright) -> None:
    assert client.get("/readyz").json()["is_ready"]
    info = client.get("/v1/info").json()
    assert info["verbs"] == ["echo", "hold", "wait", "note", "fail", "measure"]
    assert info["stop_url"] == served.stop_url
    assert "not a safety function" in info["safety_note"]
    assert "panelwright_event_loop_lag_seconds_bucket" in client.get("/metrics").text


def test_the_page_is_served_with_a_content_policy(client: httpx2.Client) -> None:
    page = client.get("/")
    assert page.headers["content-type"].startswith("text/html")
    assert "default-src 'self'" in page.headers["content-security-policy"]


def test_a_device_that_hangs_holds_up_neither_stop_nor_tasks(client: httpx2.Client, served: Panelwright) -> None:
    """If more readers hang than there are threads for them, further ones are refused, and everything else continues."""
    client.post("/v1/devices/wrist_camera/fault", json={"fault": "frozen"})
    limits = httpx2.Limits(max_connections=100)
    with (
        httpx2.Client(base_url=served.url, timeout=60.0, trust_env=False, limits=limits) as crowd,
        ThreadPoolExecutor(45) as pool,
    ):
        reads = [pool.submit(crowd.get, "/v1/devices/wrist_camera/reading") for _ in range(45)]
        eventually(lambda: sum(read.done() for read in reads) >= 5)
        assert client.post("/v1/stop").json()["is_latched"]
        assert (
            client.post("/v1/stop/reset", json={"seen_count": client.get("/v1/stop").json()["count"]}).status_code
            == 200
        )
        assert client.post("/v1/echo?wait_s=10", json={}).status_code == 200
        refused = [read.result() for read in reads if read.done()]
        assert {(answer.status_code, answer.json()["type"]) for answer in refused} == {(503, "urn:panelwright:busy")}
        assert client.post("/v1/devices/wrist_camera/fault", json={"fault": None}).status_code == 200
        assert sum(read.result().status_code == 200 for read in reads) == 45 - len(refused)
