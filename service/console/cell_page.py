"""The cell in 3-D: the arm by the model that plans, the panel in its fused pose with its uncertainty, the camera's view."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from nicegui import ui
from scipy.spatial.transform import RigidTransform, Rotation

from service.console.mirror import Mirror
from service.console.page_frame import Place, live, page_frame
from service.console.poses import base_from, frames_of, lens_of
from service.console.texts import say
from service.console.values import attribute

FIELD_DEG = 48.0
GRID = (4, 40)  # side, m, and divisions
SKY = "#eef2f5"
FRUSTUM_M = 0.35
JOINT_M, LINK_M = 0.05, 0.04  # for the eye; the planner has its own radii
SIGMAS_SHOWN = 3.0 * 10.0  # three standard deviations, ten times enlarged
ARM, PLATE, VIEW, HAZE = "#2f6fd0", "#8894a0", "#e08600", "#c03a78"


def install(place: Place) -> None:
    """Add the page at `/cell`."""

    @ui.page("/cell", title=f"{say('nav.cell')} · {say('title')}")
    def cell_page() -> None:
        mirror = place.mirror
        with page_frame(place, "cell"), ui.element("section").classes("card"):
            ui.html(say("cell.heading"), sanitize=False, tag="h2")
            with ui.element("div").props(f'role="img" aria-label="{attribute(say("cell.scene"))}"'):
                lens = ui.scene.perspective_camera(fov=FIELD_DEG)
                scene = ui.scene(width=1000, height=512, grid=GRID, camera=lens, background_color=SKY).classes("scene")
            scene.move_camera(x=-0.75, y=-1.35, z=1.35, look_at_x=0.5, look_at_y=0.0, look_at_z=0.5, duration=0)
            drawn = _Drawn(scene, mirror)
            ui.timer(0.1, drawn.renew)
            live(ui.html("", sanitize=False, tag="p"), lambda: _pose_line(mirror))
            ui.html(say("cell.legend"), sanitize=False, tag="p").classes("quiet")


def joint_frames(links: list[dict[str, float]], position_rad: list[float]) -> list[RigidTransform]:
    """Return base_from_link of each link, base first, by the Denavit-Hartenberg parameters of the arm.

    The rows are those of `hal.devices.DhLink`: turn by the joint about z, shift d along z, shift a along x, turn alpha about x.
    """
    frames = [RigidTransform.identity()]
    for link, angle in zip(links, position_rad, strict=True):
        turn = Rotation.from_euler("z", angle + link["offset_rad"])
        about_z = RigidTransform.from_components([0.0, 0.0, link["d_m"]], turn)
        along_x = RigidTransform.from_components([link["a_m"], 0.0, 0.0], Rotation.from_euler("x", link["alpha_rad"]))
        frames.append(frames[-1] * about_z * along_x)
    return frames


class _Drawn:
    """What the scene shows, renewed only where the service said something new."""

    def __init__(self, scene: Any, mirror: Mirror) -> None:
        self._scene = scene
        self._mirror = mirror
        self._parts: dict[str, tuple[Any, list[Any]]] = {}
        self._points: list[list[float]] | None = None
        self._arm_parts: list[tuple[Any, Any]] = []

    def renew(self) -> None:
        """Draw again what has changed."""
        frames = frames_of(self._mirror)
        points = self._arm_points()
        if points is not None and points != self._points:
            self._points = points
            with self._scene:
                self._arm(points)
        self._part("panel", frames.get("panel"), self._panel)
        camera = next((one["name"] for one in self._devices() if one["kind"] == "camera"), None)
        seen = base_from(frames, camera) if camera is not None else None
        lens = lens_of(self._mirror, camera) if camera is not None else None
        if seen is not None and lens is not None:
            wide = np.array([lens.width_px / lens.fx_px, lens.height_px / lens.fy_px]) * FRUSTUM_M / 2
            corners = np.array([[x, y, FRUSTUM_M] for x, y in ([-1, -1], [1, -1], [1, 1], [-1, 1]) * wide])
            self._part("view", np.round([seen.translation, *seen.apply(corners)], 4).tolist(), self._view)

    def _devices(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._mirror.said("devices", {"devices": []})["devices"]
        return found

    def _arm_points(self) -> list[list[float]] | None:
        model, reading = self._mirror.said("arm_model"), self._mirror.said("arm")
        if model is None or reading is None or not model["capabilities"]:
            return None
        frames = joint_frames(model["capabilities"]["links"], reading["value"]["position_rad"])
        points: list[list[float]] = np.round([frame.translation for frame in frames], 3).tolist()
        return points

    def _part(self, name: str, said: Any, draw: Any) -> None:
        before = self._parts.get(name)
        if said is None or (before is not None and before[0] == said):
            return
        for old in before[1] if before is not None else []:
            old.delete()
        with self._scene:
            self._parts[name] = (said, draw(said))

    def _arm(self, points: list[list[float]]) -> None:
        """Draw joints and links once and move them afterwards, which costs a browser little."""
        links = list(itertools.pairwise(np.array(points)))
        if not self._arm_parts:
            lengths = [float(np.linalg.norm(b - a)) for a, b in links]
            self._arm_parts = [
                (self._scene.sphere(JOINT_M).material(ARM), self._scene.cylinder(LINK_M, LINK_M, length).material(ARM))
                for length in (max(length, 1e-3) for length in lengths)
            ]
        for (a, b), (joint, rod) in zip(links, self._arm_parts, strict=True):
            joint.move(*b)
            rod.move(*((a + b) / 2))
            if np.linalg.norm(b - a) > 1e-3:
                turn, _ = Rotation.align_vectors([b - a], [[0.0, 1.0, 0.0]])  # a cylinder lies along y
                rod.rotate_R(turn.as_matrix().tolist())

    def _panel(self, frame: dict[str, Any]) -> list[Any]:
        panel, pose = self._mirror.panel, base_from({"panel": frame}, "panel")
        if panel is None or pose is None:
            return []
        turn = pose.rotation.as_matrix().tolist()
        middle = pose.apply([0.0, 0.0, -panel.thickness_m / 2])
        plate = (
            self._scene.box(panel.width_m, panel.height_m, panel.thickness_m)
            .move(*middle)
            .rotate_R(turn)
            .material(PLATE)
        )
        drawn = [plate]
        for one in panel.objects:
            height = one.envelope().height_m
            half_w, half_h = one.half_footprint_m
            at = pose.apply([*one.position_m, height / 2])
            drawn.append(
                self._scene.box(2 * half_w, 2 * half_h, height).move(*at).rotate_R(turn).material("#4c5d6d", 0.8)
            )
        if frame["covariance"] is not None:
            sizes, axes = np.linalg.eigh(np.array(frame["covariance"])[:3, :3])
            axes = axes * [1.0, 1.0, np.linalg.det(axes)]
            ball = self._scene.sphere(1.0).scale(*(SIGMAS_SHOWN * np.sqrt(np.maximum(sizes, 1e-12))))
            drawn.append(ball.move(*pose.translation).rotate_R(axes.tolist()).material(HAZE, 0.5))
        return drawn

    def _view(self, points: list[list[float]]) -> list[Any]:
        eye, *corners = points
        edges = [(eye, corner) for corner in corners] + list(zip(corners, [*corners[1:], corners[0]], strict=True))
        return [self._scene.line(start, end).material(VIEW) for start, end in edges]


def _pose_line(mirror: Mirror) -> str:
    frame = frames_of(mirror).get("panel")
    if frame is None:
        return attribute(say("cell.no_pose"))
    x, y, z = (f"{1e3 * v:.1f}" for v in frame["translation_m"])
    sx, sy, sz = (f"{1e3 * v:.2f}" for v in np.sqrt(np.diag(frame["covariance"]))[:3])
    return attribute(say("cell.pose", x=x, y=y, z=z, sx=sx, sy=sy, sz=sz))
