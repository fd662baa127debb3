"""Cell of fakes in front of the panel of the drawn images, for tests of stored images, teaching and calibration."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import httpx2
import numpy as np
import pytest

from hal.config import load_cell
from perception.vision.projection import CameraProjection
from service.operations import OPERATIONS
from service.serve import Options, Panelwright
from service.tasks.model import TaskState
from tests.perception.vision.bench_panel import TOML, panel, scene
from tests.service.conftest import WriteCell

PLATE = [0.60, 0.40]
Shown = tuple[np.ndarray, CameraProjection]


@pytest.fixture(scope="module")
def house(write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Panelwright]:
    """Yield a cell of fakes in front of the panel of the images, with the real verbs."""
    cell_path = write_module_cell(robot=True)
    text = TOML.replace('style = "lcd" }', 'style = "lcd", minimum = -99.0 }')
    (cell_path.parent / "panel.toml").write_text(text)
    options = Options(port=0, runs_dir=tmp_path_factory.mktemp("runs"), inline=True)
    panelwright = Panelwright(load_cell(cell_path), options, operations=OPERATIONS)
    panelwright.start()
    yield panelwright
    panelwright.close()


@pytest.fixture
def web(house: Panelwright) -> Iterator[httpx2.Client]:
    with httpx2.Client(base_url=house.url, timeout=60.0, trust_env=False) as http:
        yield http


@pytest.fixture(scope="module")
def shown() -> Shown:
    image, intrinsics, pose = scene(tilt_deg=3.0, distance_m=0.66, pose_error=0.0)
    return image, CameraProjection(intrinsics=intrinsics, camera_from_panel=pose)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def store(web: httpx2.Client, image: np.ndarray) -> str:
    answer = web.post("/v1/images", content=png(image), headers={"Content-Type": "image/png"})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def ask(web: httpx2.Client, verb: str, body: dict[str, Any]) -> httpx2.Response:
    """Ask for a verb and return its answer, or the task once it has ended: a busy machine may need longer than one wait."""
    answer = web.post(f"/v1/{verb}?wait_s=30", json=body)
    while answer.is_success and not TaskState(answer.json()["state"]).is_final:
        answer = web.get(f"/v1/tasks/{answer.json()['id']}?wait_s=30")
    return answer


def corners(view: CameraProjection, name: str, half_m: float) -> list[list[float]]:
    x, y = panel().object(name).position_m
    return view.project([[x - half_m, y + half_m, 0.0], [x + half_m, y - half_m, 0.0]]).tolist()


def is_problem(answer: httpx2.Response, status: int, kind: str, words: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert problem["type"] == f"urn:panelwright:{kind}", problem
    assert words in problem["detail"], problem
    assert len(problem["hint"]) > 8


SHOWING_NO_PANEL = pytest.mark.parametrize(
    ("change", "kind", "words"),
    [
        (np.zeros_like, "not-observable", "black"),
        (lambda image: np.full_like(image, 255), "not-observable", "saturated"),
        (lambda image: np.full_like(image, 90), "not-found", "no plate"),
        (lambda image: np.hstack([image, image]), "ambiguous", "two panels"),
    ],
    ids=["black", "saturated", "nothing", "two"],
)
