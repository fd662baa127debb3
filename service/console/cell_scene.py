"""What the drawing of the cell in 3-D shows: arm, panel, camera's view, wrench, planned way and scanner's points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from nicegui import ui
from nicegui.awaitable_response import AwaitableResponse, NullResponse

from hal.arrays import Array
from hal.geometry import from_json, skew
from service.console.mirror import Mirror
from service.console.poses import base_from, frames_of, lens_of

FRUSTUM_M = 0.35
LEAST_ROD_M = 1e-3
JOINT_M, LINK_M = 0.05, 0.04  # for the eye; the planner has its own radii
SIGMAS_SHOWN = 3.0 * 10.0  # three standard deviations, ten times enlarged
ARM, PLATE, VIEW, HAZE = "#2f6fd0", "#8894a0", "#e08600", "#c03a78"
FORCE, WAY, PLACE, POINTS = "#b3150d", "#1d7a4c", "#0f5132", (0.35, 0.2, 0.6)
FORCE_M_PER_N = 0.01
PARALLEL = 1e-9
LEAST_N = 1.0  # less is the noise of a force sensor that touches nothing
SHAFT_M, HEAD_M, HEAD_LONG_M = 0.008, 0.02, 0.05
STATION_M, POINT_M = 0.015, 0.004


def joint_frames(links: list[dict[str, float]], position_rad: list[float]) -> list[Array]:
    """Return base_from_link (4, 4) of each link, base first, by the Denavit-Hartenberg parameters of the arm.

    The rows are those of `hal.devices.DhLink`: turn by the joint about z, shift d along z, shift a along x, turn alpha about x.
    """
    frames = [np.eye(4)]
    for link, angle in zip(links, position_rad, strict=True):
        theta, alpha = angle + link["offset_rad"], link["alpha_rad"]
        (c, s), (ca, sa) = (math.cos(theta), math.sin(theta)), (math.cos(alpha), math.sin(alpha))
        link_from_next = np.array(
            [
                [c, -s * ca, s * sa, link["a_m"] * c],
                [s, c * ca, -c * sa, link["a_m"] * s],
                [0.0, sa, ca, link["d_m"]],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
        frames.append(frames[-1] @ link_from_next)
    return frames


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnLink:
    """Where a link of the arm is drawn: the joint at its end and the middle of the rod, m; `turn` (3, 3) of the rod's y axis.

    A link without length has no rod: its `turn` is None.
    """

    joint_m: list[float]
    middle_m: list[float]
    length_m: float
    turn: list[list[float]] | None


def drawn_links(links: list[dict[str, float]], position_rad: list[float]) -> list[DrawnLink]:
    """Return where the links of an arm are drawn, rounded to a millimetre; arguments as for `joint_frames`."""
    points = np.round([frame[:3, 3] for frame in joint_frames(links, position_rad)], 3)
    return [_link(a, b) for a, b in itertools.pairwise(points)]


def _link(a: Array, b: Array) -> DrawnLink:
    length_m = float(np.linalg.norm(b - a))
    turn = along_y((b - a) / length_m) if length_m > LEAST_ROD_M else None
    return DrawnLink(joint_m=b.tolist(), middle_m=((a + b) / 2).tolist(), length_m=length_m, turn=turn)


def along_y(direction: Array) -> list[list[float]]:
    """Return the rotation (3, 3) that brings a cylinder, which lies along y, into a direction of length 1."""
    if direction[1] < -1.0 + PARALLEL:
        return [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    axis = skew(np.cross([0.0, 1.0, 0.0], direction))
    turn: list[list[float]] = (np.eye(3) + axis + axis @ axis / (1.0 + direction[1])).tolist()  # Rodrigues' formula
    return turn


@dataclass(frozen=True, slots=True, kw_only=True)
class DrawnForce:
    """The arrow of a contact force: its shaft's length and middle, its head, m, and how both are turned (3, 3)."""

    length_m: float
    middle_m: list[float]
    head_m: list[float]
    turn: list[list[float]]


def drawn_force(robot: dict[str, Any]) -> DrawnForce | None:
    """Return the arrow of the contact force at the flange; None for a force that is only noise."""
    size_n = math.hypot(*robot["wrench"][:3])
    if size_n < LEAST_N:
        return None
    flange = from_json(robot["base_from_flange"])
    along = flange.rotation.apply(robot["wrench"][:3]) / size_n
    length_m = round(FORCE_M_PER_N * size_n, 3)
    middle, head = (flange.translation + along * away_m for away_m in (length_m / 2, length_m + HEAD_LONG_M / 2))
    return DrawnForce(
        length_m=length_m,
        middle_m=np.round(middle, 3).tolist(),
        head_m=np.round(head, 3).tolist(),
        turn=np.round(along_y(along), 2).tolist(),
    )


class BatchedScene(ui.scene):
    """A drawing in 3-D whose changes within `together` reach the browser in one message instead of one each."""

    _calls: list[list[Any]] | None = None

    def run_method(self, name: str, *args: Any, timeout: float = 1.0) -> AwaitableResponse:
        """Call a method of the drawing in the browser."""
        if self._calls is None:
            return super().run_method(name, *args, timeout=timeout)
        self._calls.append([name, *args])
        return NullResponse()

    @contextmanager
    def together(self) -> Iterator[None]:
        """Collect the calls of this block, and send them at its end.

        To a browser that is still loading NiceGUI sends nothing: it sends the whole drawing when the browser is ready.
        """
        calls = self._calls = []
        try:
            yield
        finally:
            self._calls = None
        if calls:
            self.run_method("run_methods", calls)


class CellScene:
    """What the scene shows, renewed only where the service said something new."""

    def __init__(self, scene: BatchedScene, mirror: Mirror) -> None:
        self._scene = scene
        self._mirror = mirror
        self._parts: dict[str, tuple[Any, list[Any]]] = {}
        self._version = -1
        self._links: list[DrawnLink] | None = None
        self._force: DrawnForce | None = None
        self._arrow: tuple[Any, Any] | None = None
        self._arm_parts: list[tuple[Any, Any]] = []

    def renew_arm(self) -> None:
        """Draw the arm and the force on it as the service told them last."""
        with self._scene.together():
            links = self._arm_links()
            if links is not None and links != self._links:
                self._links = links
                self._arm(links)
            self._draw_force()

    def renew(self) -> None:
        """Draw again what has changed besides the arm; does nothing while the service has said nothing new."""
        if self._version == self._mirror.version:
            return
        self._version = self._mirror.version
        with self._scene.together():
            self._renew()

    def _renew(self) -> None:
        frames = frames_of(self._mirror)
        planned = self._mirror.planned
        self._part("way", [] if planned is None else planned["result"]["plan"]["stations"], self._way)
        self._part("panel", frames.get("panel"), self._panel)
        camera = next((one["name"] for one in self._devices() if one["kind"] == "camera"), None)
        seen = base_from(frames, camera) if camera is not None else None
        lens = lens_of(self._mirror, camera) if camera is not None else None
        if seen is not None and lens is not None:
            wide = np.array([lens.width_px / lens.fx_px, lens.height_px / lens.fy_px]) * FRUSTUM_M / 2
            corners = np.array([[x, y, FRUSTUM_M] for x, y in ([-1, -1], [1, -1], [1, 1], [-1, 1]) * wide])
            self._part("view", np.round([seen.translation, *seen.apply(corners)], 4).tolist(), self._view)

    def show_points(self, points_m: Array) -> None:
        """Draw points (N, 3) in the frame of the base, in place of those before."""
        self._part("points", np.round(points_m, 4).tolist(), self._cloud)

    def _devices(self) -> list[dict[str, Any]]:
        found: list[dict[str, Any]] = self._mirror.said("devices", {"devices": []})["devices"]
        return found

    def _arm_links(self) -> list[DrawnLink] | None:
        model, robot = self._mirror.said("arm_model"), self._mirror.robot
        if model is None or robot is None or not model["capabilities"]:
            return None
        rows = model["capabilities"]["links"]

        def drawn(said: dict[str, Any]) -> list[DrawnLink]:
            return drawn_links(rows, said["position_rad"])

        return self._mirror.computed("arm", robot, drawn)

    def _part(self, name: str, said: Any, draw: Any) -> None:
        before = self._parts.get(name)
        if said is None or (before is not None and before[0] == said):
            return
        for old in before[1] if before is not None else []:
            old.delete()
        with self._scene:
            self._parts[name] = (said, draw(said))

    def _arm(self, links: list[DrawnLink]) -> None:
        """Draw joints and rods once and move them afterwards, which costs a browser little."""
        if not self._arm_parts:
            with self._scene:
                self._arm_parts = [
                    (
                        self._scene.sphere(JOINT_M).material(ARM),
                        self._scene.cylinder(LINK_M, LINK_M, max(link.length_m, LEAST_ROD_M)).material(ARM),
                    )
                    for link in links
                ]
        for link, (joint, rod) in zip(links, self._arm_parts, strict=True):
            joint.move(*link.joint_m)
            rod.move(*link.middle_m)
            if link.turn is not None:
                rod.rotate_R(link.turn)

    def _draw_force(self) -> None:
        """Draw the contact force as an arrow; it is made once, and moved or hidden afterwards."""
        robot = self._mirror.robot
        force = None if robot is None else self._mirror.computed("force", robot, drawn_force)
        if force == self._force:
            return
        self._force = force
        if self._arrow is None:
            with self._scene:
                shaft = self._scene.cylinder(SHAFT_M, SHAFT_M, 1.0).material(FORCE)
                self._arrow = (shaft, self._scene.cylinder(0.0, HEAD_M, HEAD_LONG_M).material(FORCE))
        shaft, head = self._arrow
        for part in self._arrow:
            part.visible(force is not None)
        if force is not None:
            shaft.scale(1.0, force.length_m, 1.0).move(*force.middle_m).rotate_R(force.turn)
            head.move(*force.head_m).rotate_R(force.turn)

    def _way(self, stations: list[dict[str, Any]]) -> list[Any]:
        """Draw the way of the flange through the stations of a plan, with a ball at each."""
        drawn: list[Any] = []
        for one in stations:
            drawn += [
                self._scene.line(start, end).material(WAY) for start, end in itertools.pairwise(one.get("flange_m", []))
            ]
            if one.get("flange_m"):
                drawn.append(self._scene.sphere(STATION_M).move(*one["flange_m"][-1]).material(PLACE))
        return drawn

    def _cloud(self, points: list[list[float]]) -> list[Any]:
        return [self._scene.point_cloud(points, [list(POINTS)] * len(points), POINT_M)] if points else []

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
        drawn: list[Any] = [plate]
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
