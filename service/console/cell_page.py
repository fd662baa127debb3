"""The cell in 3-D: what the arm does, the panel in its fused pose, the way of the last dry run, and the scanner's points."""

from __future__ import annotations

import io
from functools import partial
from typing import Any

import numpy as np
from nicegui import ui

from service.access.keys import Role
from service.console.cell_scene import BatchedScene, CellScene
from service.console.mirror import Mirror
from service.console.page_frame import Place, attempt, button, live, page_frame
from service.console.poses import base_from, frames_of, has_moved
from service.console.range_points import points_of
from service.console.texts import say
from service.console.values import attribute

FIELD_DEG = 48.0
GRID = (4, 40)  # side, m, and divisions
SKY = "#eef2f5"
DRAWN_S = 0.25
FRAMES_HZ = 30  # with the wait for the screen, which NiceGUI adds to each frame, 20 frames a second


def install(place: Place) -> None:
    """Add the page at `/cell`."""

    @ui.page("/cell", title=f"{say('nav.cell')} · {say('title')}")
    def cell_page() -> None:
        mirror = place.mirror
        with page_frame(place, "cell"), ui.element("section").classes("card"):
            ui.html(say("cell.heading"), sanitize=False, tag="h2")
            with ui.element("div").props(f'role="img" aria-label="{attribute(say("cell.scene"))}"'):
                lens = ui.scene.perspective_camera(fov=FIELD_DEG)
                scene = BatchedScene(
                    width=1000, height=512, grid=GRID, camera=lens, background_color=SKY, fps=FRAMES_HZ
                ).classes("scene")
            scene.move_camera(x=-0.75, y=-1.35, z=1.35, look_at_x=0.5, look_at_y=0.0, look_at_z=0.5, duration=0)
            drawn = CellScene(scene, mirror)
            mirror.robot_told.subscribe(drawn.renew_arm)
            ui.timer(DRAWN_S, drawn.renew)
            if mirror.may(Role.OPERATOR):
                button(say("cell.scan"), lambda: _show_points(mirror, drawn), look="plain")
            for line in (_pose_line, _force_line, _plan_line):
                live(ui.html("", sanitize=False, tag="p"), partial(line, mirror))
            ui.html(say("cell.legend"), sanitize=False, tag="p").classes("quiet")


async def _show_points(mirror: Mirror, drawn: CellScene) -> None:
    """Read the range scanner once, and draw its points where the arm stood."""
    await mirror.ask_now("scanner_model", "frames")
    model = mirror.said("scanner_model")
    before = base_from(frames_of(mirror), model["name"]) if model is not None else None
    if model is None or before is None or model["capabilities"] is None:
        ui.notify(say("cell.no_scanner"), type="negative")
        return
    data = await attempt(lambda: mirror.client.fetch("GET", f"/v1/devices/{model['name']}/reading?format=npz"))
    if data is None:
        return
    await mirror.ask_now("frames")
    if has_moved(before, base_from(frames_of(mirror), model["name"])):
        ui.notify(say("cell.scan_moved"), type="warning")
        return
    with np.load(io.BytesIO(data)) as arrays:
        points = points_of(arrays["depth_m"], model["capabilities"])
    drawn.show_points(before.apply(points))


def _pose_line(mirror: Mirror) -> str:
    frame = frames_of(mirror).get("panel")
    if frame is None:
        return attribute(say("cell.no_pose"))
    x, y, z = (f"{1e3 * v:.1f}" for v in frame["translation_m"])
    sx, sy, sz = (f"{1e3 * v:.2f}" for v in np.sqrt(np.diag(frame["covariance"]))[:3])
    return attribute(say("cell.pose", x=x, y=y, z=z, sx=sx, sy=sy, sz=sz))


def _force_line(mirror: Mirror) -> str:
    robot = mirror.robot
    if robot is None:
        return ""
    return attribute(say("cell.force", force=f"{np.linalg.norm(robot['wrench'][:3]):.1f}"))


def _plan_line(mirror: Mirror) -> str:
    task: Any = mirror.planned
    return "" if task is None else attribute(say("cell.plan", mission=task["request"].get("file") or say("plan.task")))
