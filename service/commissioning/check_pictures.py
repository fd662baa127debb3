"""Draws the pictures of the commissioning checks as PNG bytes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hal.arrays import Array
from service.report.plots import INK, figure_png, sheet

if TYPE_CHECKING:
    from service.commissioning.image_quality import ImageQuality

ORANGE, BLUE, GREEN = "#ff9f1c", "#2e86ab", "#3a9e5c"


def camera(image: NDArray[np.uint8], quality: ImageQuality) -> bytes:
    """Draw the image with the blur of each tile, a crop of its middle, and the histogram of its gray levels."""
    figure = sheet(6.0)
    grid = figure.add_gridspec(2, 2, height_ratios=(3, 1))
    shown, crop, bars = figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, :])
    height, width = image.shape
    shown.imshow(image, cmap="gray", vmin=0, vmax=255)
    rows, columns = quality.blur_map_px.shape
    for i in range(rows):
        for j in range(columns):
            blur = quality.blur_map_px[i, j]
            text, colour = ("-", "#9aa5b1") if np.isnan(blur) else (f"{blur:.1f}", GREEN if blur < 1.3 else ORANGE)
            place = ((j + 0.5) * width / columns, (i + 0.5) * height / rows)
            shown.text(*place, text, color=colour, ha="center", va="center", fontsize=10, fontweight="bold")
    shown.set_title("blur of the edges in each part, px (- no edges)", fontsize=9, color=INK)
    v, u, half = height // 2, width // 2, min(height, width) // 8
    crop.imshow(image[v - half : v + half, u - half : u + half], cmap="gray", interpolation="nearest")
    crop.set_title("the middle, enlarged", fontsize=9, color=INK)
    for pane in (shown, crop):
        pane.set_axis_off()
    bars.bar(np.arange(256), 100.0 * quality.histogram, width=1.0, color=BLUE)
    bars.axvspan(249.5, 255.5, color=ORANGE, alpha=0.3)
    bars.set_xlim(-1, 256)
    bars.set_xlabel("gray level (orange: saturated)", fontsize=8)
    bars.set_ylabel("% of the pixels", fontsize=8)
    return figure_png(figure)


def wrench(times_s: Array, wrench: Array, expected_n: Array | None) -> bytes:
    """Draw forces and torques over time; dashed lines are bias and weight by the calibration record."""
    figure = sheet(4.6)
    for pane, first, unit in zip(figure.subplots(1, 2), (0, 3), ("N", "N m"), strict=True):
        for k, (axis, colour) in enumerate(zip("xyz", (ORANGE, GREEN, BLUE), strict=True)):
            values = wrench[:, first + k]
            pane.plot(times_s - times_s[0], values, lw=0.8, color=colour, label=f"{axis}: sigma {values.std():.3g}")
            if first == 0 and expected_n is not None:
                pane.axhline(expected_n[k], color=colour, ls="--", lw=0.8)
        pane.set_ylabel(unit, fontsize=8)
        pane.set_xlabel("s", fontsize=8)
        pane.legend(fontsize=7)
        pane.set_title("force (dashed: by the record)" if first == 0 else "torque", fontsize=9, color=INK)
    return figure_png(figure)


def lights(
    dark: NDArray[np.uint8], rises: Sequence[NDArray[Any]], peaks: Sequence[tuple[float, float]], names: Sequence[str]
) -> bytes:
    """Draw the image with all lights off, and for each light what it adds, with its brightest place."""
    figure = sheet(2.6 * (1 + len(rises) // 3))
    columns = min(3, 1 + len(rises))
    panes = np.atleast_1d(figure.subplots(-(-(1 + len(rises)) // columns), columns)).ravel()
    for pane in panes:
        pane.set_axis_off()
    panes[0].imshow(dark, cmap="gray", vmin=0, vmax=255)
    panes[0].set_title("all off", fontsize=9, color=INK)
    for pane, rise, (u, v), name in zip(panes[1:], rises, peaks, names, strict=False):
        pane.imshow(np.clip(rise, 0, 120), cmap="gray", vmin=0, vmax=120)
        pane.plot(u, v, "o", ms=12, mfc="none", mec=ORANGE)
        pane.set_title(f"{name} adds {rise.max():.0f}", fontsize=8, color=INK)
    return figure_png(figure)


def arm(times_s: Array, sent_rad: Array, seen_rad: Array, lag_s: float) -> bytes:
    """Draw set-points and measured angles of the moving joint, and their difference without the lag."""
    figure = sheet(4.6)
    above, below = figure.subplots(2, 1, sharex=True)
    start = sent_rad[0]
    above.plot(times_s, 1e3 * (sent_rad - start), color=ORANGE, lw=1.0, label="set-point")
    above.plot(times_s, 1e3 * (seen_rad - start), color=BLUE, lw=1.0, label="measured")
    above.set_ylabel("mrad", fontsize=8)
    above.legend(fontsize=7)
    above.set_title(f"the last joint, {1e3 * lag_s:.0f} ms behind its set-points", fontsize=9, color=INK)
    below.plot(times_s, 1e3 * (seen_rad - np.interp(times_s - lag_s, times_s, sent_rad)), color=INK, lw=0.8)
    below.set_ylabel("rest, mrad", fontsize=8)
    below.set_xlabel("s", fontsize=8)
    return figure_png(figure)
