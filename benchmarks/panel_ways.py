"""Measures each way of finding the panel on simulated overviews: pose errors, and whether the covariance fits them.

`python -m benchmarks.panel_ways [FIRST LAST]` draws the panel of every seed once with border lights and once with four
printed tags in their places, looks at each from the expected overview and from square in front of it, and prints for
every way the share found, the pose errors, and NEES / 6 (1 if the covariance is right). The lens is drawn around its
calibration record as in the simulated cell, and the ways know the record only.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.config import Cell, load_cell
from hal.errors import CellError
from hal.geometry import UncertainPose, difference, perturbed, transform_rpy
from hal.panel import Panel, Tag
from perception.vision import (
    Knowledge,
    PanelPrior,
    find_by_looks,
    find_by_outline,
    find_by_tags,
    find_panel,
    viewpoints,
)
from service.knowledge.store import KnowledgeStore
from simbackend.camera import CameraOptions
from simbackend.camera_sensor import NOMINAL_EXPOSURE_S, CameraSensor, SensorOptions
from simbackend.draws import Draws
from simbackend.panel_world import PanelWorld
from simbackend.wire import PictureInfo

ROOT = Path(__file__).resolve().parents[1]
FIRST, LAST = 900, 939
TAG_SIZE_M, TAG_AT_M = 0.040, (0.277, 0.197)
EDGE_M = 0.0005
LENS_RMS_PX = 0.15
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One pose of the camera before one built panel: images with the lights off and on, the truth and the prior."""

    panel: Panel
    off: Pixels
    on: Pixels
    lens: CameraIntrinsics
    lenses: tuple[CameraIntrinsics, ...]
    camera_from_panel: RigidTransform
    prior: PanelPrior


def with_tags(panel: Panel) -> Panel:
    """Return the panel with four tags in the places of its lights, and edges with the usual tolerance."""
    x, y = TAG_AT_M
    places = ((-x, y), (x, y), (x, -y), (-x, -y))
    tags = tuple(Tag(id=k, size_m=TAG_SIZE_M, position_m=(*place, 0.0)) for k, place in enumerate(places))
    tolerances = panel.tolerances.model_copy(update={"edge_m": EDGE_M})
    return panel.model_copy(update={"lights": (), "tags": tags, "tolerances": tolerances})


@contextmanager
def drawn(cell: Cell) -> Iterator[PanelWorld]:
    """Yield the panel of a cell in an engine of its own."""
    import pybullet

    engine = pybullet.connect(pybullet.DIRECT)
    try:
        with tempfile.TemporaryDirectory() as folder:
            yield PanelWorld(pybullet, cell, Draws(cell.file.cell.seed), Path(folder))
    finally:
        pybullet.disconnect(engine)


def views(cell: Cell) -> Iterator[View]:
    """Yield the views of one built panel: from where the cell file expects it, and square in front of it."""
    seed, workspace = cell.file.cell.seed, cell.file.workspace
    record = cell.calibration_of("wrist_camera").intrinsics
    assert record is not None
    lens = record.intrinsics()
    o = CameraOptions()
    sensor = CameraSensor(
        Draws(seed).lens("wrist_camera", lens),
        SensorOptions(
            oversample=o.oversample, blur_px=o.blur_px, vignette=o.vignette,
            full_well_electrons=o.full_well_electrons, read_noise_electrons=o.read_noise_electrons, is_colour=False,
        ),
    )  # fmt: skip
    expected = transform_rpy(workspace.panel_position_m, workspace.panel_rpy_rad)
    rng = np.random.default_rng([seed, 77])
    with drawn(cell) as world:
        true = world.base_from_panel
        near = perturbed(true, rng.normal(scale=[0.003] * 3 + [0.006] * 3))
        for pose, slack_m in ((expected, 0.6 * workspace.position_tolerance_m), (near, 0.01)):
            base_from_camera = next(viewpoints.overview_poses(pose, cell.panel, lens, slack_m))
            base_from_camera = base_from_camera * transform_rpy((0.0, 0.0, 0.0), tuple(rng.normal(scale=0.002, size=3)))
            off, on = (_exposed(world, sensor, base_from_camera, rng, lit=lit) for lit in (False, True))
            camera = base_from_camera.inv()
            yield View(
                panel=cell.panel, off=off, on=on, lens=lens, lenses=record.one_sigma_lenses(),
                camera_from_panel=camera * true,
                prior=PanelPrior(
                    camera_from_panel=camera * pose, camera_from_expected=camera * expected,
                    position_tolerance_m=workspace.position_tolerance_m,
                    angle_tolerance_rad=workspace.angle_tolerance_rad,
                ),
            )  # fmt: skip


def _exposed(
    world: PanelWorld, sensor: CameraSensor, base_from_camera: RigidTransform, rng: np.random.Generator, *, lit: bool
) -> Pixels:
    world.switch_lights([lit] * len(world.panel.lights))
    width, height = sensor.drawn
    image, _ = world.scene.draw(
        base_from_camera, width=width, height=height, focal=sensor.focal, centre=sensor.centre, near_m=0.02, channels=1
    )
    info = PictureInfo(
        tick=0, stamp_s=0.0, camera_from_base=base_from_camera.inv(), base_from_panel=world.base_from_panel,
        lit=world.emitters(),
    )  # fmt: skip
    return sensor.expose(info, image[:, :, 0], NOMINAL_EXPOSURE_S, rng)


def by_lights(view: View) -> UncertainPose:
    """Find the panel by its lights."""
    lights_m = np.array([light.position_m for light in view.panel.lights])
    return find_panel(
        view.off, view.on, lights_m, view.lens, prior=view.prior, lens_rms_px=LENS_RMS_PX,
        light_sigma_m=view.panel.tolerances.light_m,
    ).camera_from_panel  # fmt: skip


def _by(way: Callable[..., Any]) -> Callable[[View], UncertainPose]:
    def find(view: View) -> UncertainPose:
        pose: UncertainPose = way(
            view.off, view.panel, view.lens, prior=view.prior, lens_rms_px=LENS_RMS_PX
        ).camera_from_panel
        return pose

    return find


def by_looks(view: View) -> UncertainPose:
    """Find the panel by its objects, with the looks that ship with the bench cell."""
    return find_by_looks(
        view.off, view.panel, view.lens, _knowledge(), prior=view.prior, lens_rms_px=LENS_RMS_PX
    ).camera_from_panel


@cache
def _knowledge() -> Knowledge:
    return KnowledgeStore(Path("runs/none"), of_cell=ROOT / "cells/knowledge/bench").knowledge()


def one_tag(view: View) -> UncertainPose:
    """Find the panel by one of its tags alone."""
    alone = view.panel.model_copy(update={"tags": view.panel.tags[:1]})
    return _by(find_by_tags)(replace(view, panel=alone))


WAYS: dict[str, Callable[[View], UncertainPose]] = {
    "four lights": by_lights,
    "four tags": _by(find_by_tags),
    "one tag": one_tag,
    "outline": _by(find_by_outline),
    "looks": by_looks,
}


def judge(find: Callable[[View], UncertainPose], view: View) -> tuple[float, ...]:
    """Return the position error (m), the angle error (rad), and NEES / 6 without and with the errors of the lens.

    The pose of a sighting states the noise of the image; the errors of the lens calibration, which all sightings share,
    are added to it as missions add them: by repeating the estimate with each one-sigma lens.
    """
    found = find(view)
    off: Array = difference(view.camera_from_panel, found.parent_from_child)
    covariance = found.covariance.copy()
    for lens in view.lenses:
        moved = difference(find(replace(view, lens=lens)).parent_from_child, found.parent_from_child)
        covariance += np.outer(moved, moved)
    alone, with_lens = (float(off @ np.linalg.solve(c, off)) / 6.0 for c in (found.covariance, covariance))
    return float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])), alone, with_lens


def measure(seeds: Sequence[int], names: Sequence[str]) -> Iterator[str]:
    """Yield one line of figures for each way and place of the camera, then the reasons of refusals."""
    bench = load_cell(ROOT / "cells/bench.toml")
    tagged = bench.model_copy(update={"panel": with_tags(bench.panel)})
    results: dict[tuple[str, str], list[tuple[float, ...]]] = {}
    refused: dict[tuple[str, str], list[str]] = {}
    for seed in seeds:
        for base, some in ((bench, ("four lights",)), (tagged, tuple(n for n in names if n != "four lights"))):
            section = base.file.cell.model_copy(update={"seed": seed})
            cell = base.model_copy(update={"file": base.file.model_copy(update={"cell": section})})
            for place, view in zip(("overview", "square"), views(cell), strict=True):
                for name in (name for name in some if name in names):
                    key = (name, place)
                    try:
                        judged = judge(WAYS[name], view)
                        results.setdefault(key, []).append(judged)
                    except CellError as error:
                        refused.setdefault(key, []).append(f"seed {seed}: {error.what}")
    for key in sorted({*results, *refused}, key=lambda key: (list(WAYS).index(key[0]), key[1])):
        rows = np.array(results.get(key, np.full((1, 4), np.nan)))
        mm, mrad, alone, nees = 1e3 * rows[:, 0], 1e3 * rows[:, 1], rows[:, 2], rows[:, 3]
        yield (
            f"{key[0]:<12} {key[1]:<9} found {len(results.get(key, []))} of {len(seeds)}  "
            f"position {np.median(mm):.2f} mm (median) {np.quantile(mm, 0.95):.2f} (95 %)  "
            f"angle {np.median(mrad):.2f} mrad {np.quantile(mrad, 0.95):.2f}  "
            f"NEES/6 {nees.mean():.2f} (largest {nees.max():.1f}; without lens {alone.mean():.2f})"
        )
    for key, reasons in refused.items():
        yield f"refused {key}: {reasons[:4]}"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; see the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, nargs="?", default=FIRST)
    parser.add_argument("last", type=int, nargs="?", default=LAST)
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    given = parser.parse_args(arguments)
    print("\n".join(measure(range(given.first, given.last + 1), given.ways)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
