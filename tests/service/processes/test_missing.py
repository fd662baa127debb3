"""A cell is served without the devices that do not connect; the others work, and the rest is connected later."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest

from hal.config import load_cell
from hal.errors import CellError
from service.client import DEFAULT_URL
from service.commands.serve import announcement
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS
from tests.service.waiting import eventually

AWAY = "away"


class ServedClient(httpx2.Client):
    """Client of a service, which it also holds."""

    panelwright: Panelwright


Serve = Callable[..., ServedClient]


@pytest.fixture
def trouble(tmp_path: Path) -> Path:
    """Return a file that states the fault of the devices that read it."""
    file = tmp_path / "trouble"
    file.write_text(AWAY)
    return file


@pytest.fixture
def serve(write_cell: WriteCell, trouble: Path, tmp_path: Path) -> Iterator[Serve]:
    """Yield a function that serves a cell of fakes in which the given devices are absent."""
    opened: list[Any] = []

    def serve(*away: str, inline: bool = True) -> ServedClient:
        path = write_cell(robot=True, options={name: {"trouble": str(trouble)} for name in away})
        options = Options(port=0, runs_dir=tmp_path / "runs", inline=inline, partial=True, warm=False)
        panelwright = Panelwright(load_cell(path), options, operations=OPERATIONS)
        opened.append(panelwright)
        panelwright.start()
        http = ServedClient(base_url=panelwright.url, timeout=60.0, trust_env=False)
        http.panelwright = panelwright
        opened.append(http)
        return http

    yield serve
    for panel_object in reversed(opened):
        panel_object.close()


def test_a_cell_without_its_stop_process_is_not_running(serve: Serve, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its resets are refused, so whoever waits until the cell is ready must wait for the stop process as well."""
    monkeypatch.setattr("service.processes.stop_host.PAUSES_S", (60.0,))
    http = serve(inline=False)
    eventually(lambda: http.get("/readyz").status_code == 200)
    stop = next(each for each in http.get("/readyz").json()["processes"] if each["name"] == "stop")
    os.kill(stop["pid"], signal.SIGKILL)
    eventually(lambda: http.get("/readyz").status_code == 503)
    ready = http.get("/readyz").json()
    assert (ready["is_running"], ready["is_ready"]) == (False, False)
    assert [each["detail"] for each in ready["processes"]] == ["", "the stop process is being started"]


def test_what_is_missing_is_named_and_the_rest_works(serve: Serve, trouble: Path) -> None:
    http = serve("panel_lights", "finger_proximity", inline=False)
    ready = http.get("/readyz")
    assert ready.status_code == 200
    assert {each["device"]: each["why"] for each in ready.json()["missing"]} == {
        name: f"{name} is not on its port" for name in ("panel_lights", "finger_proximity")
    }
    health = http.get("/v1/devices/panel_lights").json()["health"]
    assert (health["connected"], "is not on its port" in health["detail"]) == (False, True)
    assert http.get("/v1/devices/wrist_camera/reading").status_code == 200
    problem = http.post("/v1/measure?wait_s=10").json()
    assert (problem["type"], problem["details"]["device"]) == ("urn:panelwright:not-connected", "finger_proximity")
    assert problem["hint"] == "plug it in; then POST /v1/devices/finger_proximity/connect"

    trouble.unlink()
    assert http.post("/v1/devices/finger_proximity/connect").json()["health"]["connected"]
    assert http.post("/v1/measure?wait_s=10").json()["result"] == {"distance_m": 0.123}
    assert [each["device"] for each in http.get("/readyz").json()["missing"]] == ["panel_lights"]


def test_readiness_says_what_is_missing_and_what_is_lost_without_it(serve: Serve, trouble: Path) -> None:
    http = serve("panel_lights", "finger_touch")
    ready = http.get("/readyz")
    assert (ready.status_code, ready.json()["is_running"], ready.json()["is_ready"]) == (200, True, False)
    lost = {each["device"]: each["lost"] for each in ready.json()["missing"]}
    assert lost == {"panel_lights": [], "finger_touch": ["hold", "wait"]}
    lacking = ready.json()["lacking"]
    assert (lacking["echo"], lacking["hold"]) == ([], ["finger_touch"])
    assert "panelwright_devices_missing 2.0" in http.get("/metrics").text
    trouble.unlink()
    for name in lost:
        http.post(f"/v1/devices/{name}/connect")
    assert http.get("/readyz").json()["is_ready"]


def test_serve_says_what_is_lost_and_names_the_service_in_the_remedy(serve: Serve) -> None:
    served = serve("finger_touch")
    service, url = served.panelwright.service, served.panelwright.url
    told = "\n".join(announcement(service, url, "http://x/v1/stop"))
    assert f"`panelwright devices connect finger_touch --url {url}`" in told
    assert "lost   hold, wait" in told and "without 1 of 8 devices" in told
    assert "--url" not in "\n".join(announcement(service, DEFAULT_URL, "http://x/v1/stop"))


@pytest.mark.parametrize("name", ["arm", "gripper", "wrist_ft", "finger_touch", "finger_proximity"])
def test_nothing_moves_without_a_device_of_the_motion_until_it_is_there(serve: Serve, trouble: Path, name: str) -> None:
    http = serve(name)
    held = http.post("/v1/hold?wait_s=10", json={"seconds": 0.2})
    assert (held.status_code, held.json()["details"]["device"]) == (503, name)
    trouble.unlink()
    assert http.post(f"/v1/devices/{name}/connect").status_code == 200
    assert http.post("/v1/hold?wait_s=10", json={"seconds": 0.2}).json()["state"] == "succeeded"


def test_of_two_that_are_missing_the_first_one_that_comes_starts_no_motion(serve: Serve, trouble: Path) -> None:
    http = serve("arm", "gripper")
    trouble.unlink()
    assert http.post("/v1/devices/gripper/connect").status_code == 200
    assert http.post("/v1/hold?wait_s=10").json()["details"]["device"] == "arm"
    assert http.post("/v1/devices/arm/connect").status_code == 200
    assert http.post("/v1/hold?wait_s=10", json={"seconds": 0.2}).json()["state"] == "succeeded"


def test_another_try_that_fails_says_why_and_leaves_the_way_open(serve: Serve, trouble: Path) -> None:
    http = serve("panel_lights")
    refused = http.post("/v1/devices/panel_lights/connect")
    assert (refused.status_code, refused.json()["detail"]) == (503, "panel_lights is not on its port")
    wrong = http.put("/v1/devices/panel_lights", json={"driver": "fake:camera"})
    assert (wrong.status_code, "is a camera, not a lights" in wrong.json()["detail"]) == (422, True)
    assert "is a camera" in http.get("/v1/devices/panel_lights").json()["health"]["detail"]
    assert http.put("/v1/devices/panel_lights", json={"driver": "fake:lights"}).status_code == 200
    assert http.get("/readyz").json()["missing"] == []


def test_a_device_that_is_there_is_connected_anew(serve: Serve) -> None:
    http = serve()
    assert http.get("/readyz").json()["missing"] == []
    before = [http.get("/v1/devices/panel_lights/reading").json()["sequence"] for _ in range(3)]
    assert http.post("/v1/devices/panel_lights/connect").status_code == 200
    assert http.get("/v1/devices/panel_lights/reading").json()["sequence"] < before[-1]


def test_a_wrong_file_ends_the_service_all_the_same(write_cell: WriteCell, tmp_path: Path) -> None:
    path = write_cell(options={"panel_lights": {"fail": "no answer"}, "wrist_camera": {"wrong_key": 1}})
    options = Options(port=0, runs_dir=tmp_path / "runs", inline=True, partial=True, warm=False)
    panelwright = Panelwright(load_cell(path), options, operations=OPERATIONS)
    with pytest.raises(CellError, match="2 of the 4 devices") as refused:
        panelwright.start()
    assert set(refused.value.details) == {"panel_lights", "wrist_camera"}


def test_a_cell_that_starts_anew_goes_on_without_what_has_gone(serve: Serve, trouble: Path) -> None:
    trouble.unlink()
    http = serve("panel_lights", inline=False)
    assert http.get("/readyz").json()["missing"] == []
    trouble.write_text(AWAY)
    cell = next(each for each in http.get("/readyz").json()["processes"] if each["name"] == "cell")

    os.kill(cell["pid"], signal.SIGKILL)
    eventually(lambda: http.get("/readyz").status_code == 503)
    eventually(lambda: http.get("/readyz").status_code == 200)
    assert [each["device"] for each in http.get("/readyz").json()["missing"]] == ["panel_lights"]
