"""Random quantities derived from the seed: each has a stream of its own, so adding one never changes another."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.calibration import CameraIntrinsics, MountRecord, ToolLoad
from hal.config import SimulationSection, WorkspaceSection
from hal.geometry import perturbed, transform_rpy

FOCAL_RATIO_SIGMA = 0.0005
CENTRE_SIGMA_PX = 0.3
RADIAL_SIGMA = 0.002
MASS_RATIO_SIGMA = 0.02
CENTRE_OF_MASS_SIGMA_M = 0.001
BIAS_SIGMA_N = 1.0
BIAS_SIGMA_NM = 0.05


NOISE_BLOCK = 512


class TickNoise:
    """Random numbers as a function of the tick, generated in blocks: a generator per tick costs ten times more."""

    def __init__(self, draws: Draws, name: str, width: int) -> None:
        self._draws, self._name, self._width = draws, name, width
        self._block: tuple[int, Array] = (-1, np.empty((0, width)))

    def at(self, tick: int) -> Array:
        """Return the (width,) numbers of a tick."""
        number, row = divmod(tick, NOISE_BLOCK)
        held, block = self._block
        if held != number:
            block = self._draws.at_tick(self._name, number).standard_normal((NOISE_BLOCK, self._width))
            self._block = (number, block)  # one assignment, so that another thread sees the old or the new pair
        numbers: Array = block[row]
        return numbers


@dataclass(frozen=True, slots=True)
class Draws:
    """Random numbers by name, derived from the seed."""

    seed: int

    def stream(self, name: str) -> np.random.Generator:
        """Return a generator that depends on the seed and the name only."""
        return np.random.default_rng([self.seed, zlib.crc32(name.encode())])

    def at_tick(self, name: str, tick: int) -> np.random.Generator:
        """Return the generator for the noise of `name` at `tick`.

        Counter-based, so it does not depend on who asks or how often.
        """
        return np.random.Generator(
            np.random.Philox(key=[self.seed, zlib.crc32(name.encode())], counter=[0, 0, 0, tick])
        )

    def noise(self, name: str, width: int) -> TickNoise:
        """Return standard normal numbers of `name`, `width` per tick, for sensors that are read every tick."""
        return TickNoise(self, name, width)

    def mount(self, device: str, record: MountRecord) -> RigidTransform:
        """Return the device's true pose: the record's pose, perturbed according to its sigma."""
        sigma = np.array([*record.sigma_m, *record.sigma_rad])
        return perturbed(record.pose().parent_from_child, sigma * self.stream(f"mount/{device}").standard_normal(6))

    def lens(self, device: str, nominal: CameraIntrinsics) -> CameraIntrinsics:
        """Return the true lens of a camera whose record says `nominal`."""
        z = self.stream(f"lens/{device}").standard_normal(4)
        focal = 1.0 + FOCAL_RATIO_SIGMA * z[0]
        k1, k2, p1, p2, k3 = nominal.distortion
        return CameraIntrinsics(
            width_px=nominal.width_px,
            height_px=nominal.height_px,
            fx_px=nominal.fx_px * focal,
            fy_px=nominal.fy_px * focal,
            cx_px=nominal.cx_px + CENTRE_SIGMA_PX * z[1],
            cy_px=nominal.cy_px + CENTRE_SIGMA_PX * z[2],
            distortion=(k1 + RADIAL_SIGMA * z[3], k2, p1, p2, k3),
        )

    def load(self, device: str, nominal: ToolLoad) -> ToolLoad:
        """Return the true tool load and sensor bias."""
        z = self.stream(f"load/{device}").standard_normal(10)
        centre = np.asarray(nominal.centre_of_mass_m) + CENTRE_OF_MASS_SIGMA_M * z[1:4]
        bias = np.asarray(nominal.bias) + np.array([BIAS_SIGMA_N] * 3 + [BIAS_SIGMA_NM] * 3) * z[4:]
        return ToolLoad(
            mass_kg=nominal.mass_kg * (1.0 + MASS_RATIO_SIGMA * z[0]),
            centre_of_mass_m=(float(centre[0]), float(centre[1]), float(centre[2])),
            bias=tuple(float(b) for b in bias),  # type: ignore[arg-type]  # six by construction
        )

    def panel_pose(self, workspace: WorkspaceSection, simulation: SimulationSection) -> RigidTransform:
        """Return base_from_panel, uniform around the expected pose."""
        spread_m = min(simulation.panel_spread_m, workspace.position_tolerance_m)
        spread_rad = min(simulation.panel_spread_rad, workspace.angle_tolerance_rad)
        u = self.stream("panel/pose").uniform(-1.0, 1.0, 6)
        # Drawn in a cube; points beyond the limit of the cell file (the corners) are moved in to it.
        shift = spread_m * u[:3]
        shift *= min(1.0, workspace.position_tolerance_m / max(float(np.linalg.norm(shift)), 1e-12))
        turn = spread_rad * u[3:] / max(1.0, float(np.linalg.norm(u[3:])))
        expected = transform_rpy(workspace.panel_position_m, workspace.panel_rpy_rad)
        return perturbed(expected, np.concatenate([shift, turn]))
