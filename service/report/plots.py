"""Draws the report's pictures (lights, ranges, stations, wrenches and joints) as PNG bytes."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from hal.motion import MotionReport

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Pixels = NDArray[np.uint8]
INK, SOFT = "#1c2733", "#5a6b7b"
DRAWN_COLUMNS = 800  # of a curve; its pane is about as many pixels wide
PATH_POINTS = 200
CROP_MARGIN_PX = 8
MOST_PX = 1100
ON_PLATE_M = 0.005


def png_of(pixels: Pixels) -> bytes:
    """Encode pixels, uint8 (H, W) gray or (H, W, 3) RGB, as PNG."""
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG")
    return stream.getvalue()


def small_picture(path: Path) -> bytes:
    """Return a picture of a report as JPEG of at most 1100 px; a fifth of the bytes of a camera's image as PNG."""
    stream = io.BytesIO()
    with Image.open(path) as image:
        small = image.convert("RGB")
    small.thumbnail((MOST_PX, MOST_PX))
    small.save(stream, "JPEG", quality=88)
    return stream.getvalue()


def cut_out(pixels: Pixels, outline_px: NDArray[Any]) -> Pixels | None:
    """Return the part of an image with an outline, px (N, 2), and a margin; None when it lies outside of the image."""
    if len(outline_px) == 0 or not np.isfinite(outline_px).all():
        return None
    low = np.floor(outline_px.min(axis=0)).astype(int) - CROP_MARGIN_PX
    high = np.ceil(outline_px.max(axis=0)).astype(int) + CROP_MARGIN_PX
    height, width = pixels.shape[:2]
    left, right = (int(np.clip(u, 0, width)) for u in (low[0], high[0]))
    top, bottom = (int(np.clip(v, 0, height)) for v in (low[1], high[1]))
    return pixels[top:bottom, left:right] if left < right and top < bottom else None


def lights_picture(image_off: Pixels, image_on: Pixels, centres_px: NDArray[Any], names: Sequence[str]) -> bytes:
    """Draw the images with lights on and off, and their difference with the four lights circled."""
    figure = sheet(3.1)
    panes = figure.subplots(1, 3)
    difference = image_on.astype(int) - image_off.astype(int)
    if difference.ndim == 3:
        difference = difference.mean(axis=2).astype(int)
    for pane, pixels, title in zip(
        panes,
        (image_off, image_on, np.clip(difference, 0, 255)),
        ("lights off", "lights on", "on minus off"),
        strict=True,
    ):
        show_image(pane, pixels.astype(np.uint8), 350)
        pane.set_title(title, fontsize=9, color=INK)
        pane.set_axis_off()
    for (u, v), name in zip(centres_px, names, strict=True):
        panes[2].plot(u, v, "o", ms=12, mfc="none", mec="#ff9f1c")
        panes[2].annotate(
            name, (u, v), xytext=(0, 10), textcoords="offset points", color="#ff9f1c", fontsize=6, ha="center"
        )
    return figure_png(figure)


def points_picture(image: Pixels, points_px: NDArray[Any], names: Sequence[str]) -> bytes:
    """Draw an image with the points that show where the panel is."""
    figure = sheet(4.6)
    pane = figure.subplots()
    show_image(pane, image, 640)
    pane.set_axis_off()
    for (u, v), name in zip(points_px, names, strict=True):
        pane.plot(u, v, "o", ms=5, mfc="none", mec="#ff9f1c")
        pane.annotate(name, (u, v), xytext=(0, 6), textcoords="offset points", color="#ff9f1c", fontsize=5, ha="center")
    return figure_png(figure)


def residual_picture(
    depth_m: NDArray[Any], lens: tuple[float, float, float, float], point_m: NDArray[Any], normal: NDArray[Any]
) -> bytes:
    """Draw a range image of a pinhole scanner (fx, fy, cx, cy) and its residuals from a plane."""
    fx, fy, cx, cy = lens
    v, u = np.mgrid[: depth_m.shape[0], : depth_m.shape[1]]
    points = np.stack([(u - cx) / fx * depth_m, (v - cy) / fy * depth_m, depth_m], axis=-1)
    residual_m = (points - point_m) @ normal
    rows, columns = box_of(np.abs(residual_m) < ON_PLATE_M)
    return range_picture(depth_m[rows, columns], residual_m[rows, columns])


def box_of(shown: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the rows and columns of what is shown: without its outermost hundredths, with a margin; all if nothing is."""
    v, u = np.nonzero(shown)
    if len(v) == 0:
        return slice(None), slice(None)
    cut = []
    for index, length in ((v, shown.shape[0]), (u, shown.shape[1])):
        low, high = np.quantile(index, (0.01, 0.99))
        margin = 0.08 * (high - low) + 1
        cut.append(slice(max(0, int(low - margin)), min(length, int(high + margin) + 1)))
    return cut[0], cut[1]


def range_picture(depth_m: NDArray[Any], residual_m: NDArray[Any]) -> bytes:
    """Draw the range image and its residuals from the fitted plane."""
    figure = sheet(4.2)
    left, right = figure.subplots(1, 2)
    shown = left.imshow(depth_m, cmap="viridis")
    left.set_title("range, m", fontsize=9, color=INK)
    figure.colorbar(shown, ax=left, shrink=0.85)
    shown = right.imshow(1e3 * residual_m, cmap="coolwarm", vmin=-40, vmax=40)
    right.set_title("distance from the fitted plane, mm (red: in front of it)", fontsize=9, color=INK)
    figure.colorbar(shown, ax=right, shrink=0.85)
    for pane in (left, right):
        pane.set_axis_off()
    return figure_png(figure)


def stations_picture(
    panel_from_camera: Sequence[NDArray[Any]], size_m: tuple[float, float], residuals_px: NDArray[Any]
) -> bytes:
    """Draw the camera's stations before the plate (4x4 poses `panel_from_camera`) and the residuals in pixels."""
    figure = sheet(4.6)
    room = figure.add_subplot(1, 2, 1, projection="3d")
    x, y = size_m[0] / 2, size_m[1] / 2
    plate = np.array([[-x, -y], [x, -y], [x, y], [-x, y], [-x, -y]])
    room.plot(plate[:, 0], np.zeros(5), plate[:, 1], color=INK, lw=1.5)
    for k, pose in enumerate(panel_from_camera, 1):
        place = pose[:3, 3]
        for axis, colour in ((0, "#d1495b"), (1, "#3a9e5c"), (2, "#2e86ab")):
            tip = place + 0.08 * pose[:3, axis]
            room.plot(*np.array([place, tip]).T[[0, 2, 1]], color=colour, lw=1.6)
        room.text(place[0], place[2], place[1], f" {k}", fontsize=7, color=SOFT)
    room.set_xlabel("x, m", fontsize=7, color=SOFT)
    room.set_ylabel("distance from the plate, m", fontsize=7, color=SOFT)
    room.set_zlabel("y, m", fontsize=7, color=SOFT)
    room.tick_params(labelsize=6, colors=SOFT)
    room.set_aspect("equal")
    room.view_init(elev=22, azim=58)
    room.set_title("stations of the camera, lines of sight in blue", fontsize=9, color=INK)
    miss = figure.add_subplot(1, 2, 2)
    for k, one in enumerate(residuals_px):
        miss.plot(*one.T, "o", ms=3.5, color=f"C{k % 10}", alpha=0.8)
    rms = float(np.sqrt(np.mean(residuals_px**2)))
    turn = np.linspace(0.0, 2 * np.pi, 100)
    miss.plot(rms * np.cos(turn), rms * np.sin(turn), color=SOFT, lw=0.8)
    miss.axhline(0.0, color=SOFT, lw=0.4)
    miss.axvline(0.0, color=SOFT, lw=0.4)
    miss.set_aspect("equal", adjustable="datalim")
    miss.set_xlabel("px", fontsize=8, color=SOFT)
    miss.tick_params(labelsize=7, colors=SOFT)
    miss.set_title(f"residuals of the lights, rms {rms:.3f} px", fontsize=9, color=INK)
    return figure_png(figure)


def wrench_picture(motions: Sequence[MotionReport]) -> bytes:
    """Plot contact force and torque over the whole mission, with the names of the motions that pushed hard."""
    figure = sheet(4.2)
    force, torque = figure.subplots(2, 1, sharex=True)
    times, wrench = _joined(motions, lambda m: m.log.wrench)
    for k, axis in enumerate("xyz"):
        force.plot(*thinned(times, wrench[:, k]), lw=0.8, label=axis)
        torque.plot(*thinned(times, wrench[:, 3 + k]), lw=0.8, label=axis)
    for motion in motions:
        if motion.peak_force_n > 6.0:
            force.annotate(motion.name, (motion.started_s, motion.peak_force_n), fontsize=6, color=SOFT, rotation=30)
    force.set_ylabel("contact force, N")
    torque.set_ylabel("torque, N m")
    torque.set_xlabel("cell time, s")
    force.legend(ncols=3, fontsize=7, frameon=False, loc="upper left")
    return _finished(figure, (force, torque))


def joints_picture(motions: Sequence[MotionReport]) -> bytes:
    """Plot the joint angles over the whole mission."""
    figure = sheet(3.4)
    pane = figure.subplots()
    times, joints = _joined(motions, lambda m: m.log.positions_rad)
    for k in range(joints.shape[1]):
        pane.plot(*thinned(times, joints[:, k]), lw=0.9, label=f"joint {k + 1}")
    pane.set_ylabel("rad")
    pane.set_xlabel("cell time, s")
    pane.legend(ncols=7, fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return _finished(figure, (pane,))


def _joined(motions: Sequence[MotionReport], pick: Any) -> tuple[NDArray[Any], NDArray[Any]]:
    pieces = [(m.started_s + m.log.times_s, pick(m)) for m in motions if len(m.log.times_s)]
    if not pieces:
        return np.zeros(1), np.zeros((1, 6))
    return np.concatenate([t for t, _ in pieces]), np.concatenate([v for _, v in pieces])


def thinned(times: NDArray[Any], values: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the lowest and highest sample of each of 800 stretches of a curve (N,), in order, so that no peak is lost."""
    if len(times) <= 2 * DRAWN_COLUMNS:
        return times, values
    edges = np.linspace(0, len(times), DRAWN_COLUMNS + 1).astype(int)
    kept = sorted({i + int(pick(values[i:j])) for i, j in pairwise(edges) for pick in (np.argmin, np.argmax)})
    return times[kept], values[kept]


def show_image(pane: Any, pixels: Pixels, most_px: int, alpha: float = 1.0) -> None:
    """Show a gray (H, W) or colour (H, W, 3) image in a pane, made smaller first where it is wider than `most_px`.

    OpenCV makes it smaller while other threads of this process run; matplotlib lets them wait, 40 ms for a camera's image.
    """
    height, width = pixels.shape[:2]
    extent = (-0.5, width - 0.5, height - 0.5, -0.5)
    if width > most_px:
        size = (most_px, round(height * most_px / width))
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    pane.imshow(pixels, cmap="gray", vmin=0, vmax=255, extent=extent, alpha=alpha)


def sheet(height_in: float) -> Figure:
    from matplotlib.figure import Figure  # takes half a second to import, so not at the start

    return Figure(figsize=(10.5, height_in), dpi=100, layout="constrained")


def _finished(figure: Figure, panes: Sequence[Any]) -> bytes:
    for pane in panes:
        pane.spines[["top", "right"]].set_visible(False)
        pane.tick_params(labelsize=8)
        pane.grid(alpha=0.25)
    return figure_png(figure)


def figure_png(figure: Figure) -> bytes:
    """Return a finished figure as PNG bytes, and empty it.

    Long curves are drawn in pieces, because the event loop waits while one is drawn, 50 ms for 7500 points. An emptied figure
    keeps 1 MB until a full garbage collection, which comes after minutes; with its curves and its canvas it would keep 10 MB.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    with rc_context({"agg.path.chunksize": PATH_POINTS}):
        canvas = FigureCanvasAgg(figure)
        canvas.print_png(stream)  # type: ignore[no-untyped-call]  # matplotlib has no annotation here
    figure.clear()
    del canvas.renderer
    return stream.getvalue()
