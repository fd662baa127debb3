"""Compares the paper's direct pose from four lights (Section II-B) with ours: python examples/paper/direct_pose.py

Three lights give up to four poses, and the fourth light selects one (Grunert 1841; Haralick et al., IJCV 13(3), 1994).
The method needs no initial value, but fits its first three lights exactly. Ours minimises the reprojection error of all
four and returns the covariance and all mirror poses. The paper states no errors, so both methods are measured here on
the same simulated views.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.camera_model import project
from hal.errors import NotFound
from perception.vision import estimate

CAMERA = CameraIntrinsics(width_px=640, height_px=480, fx_px=500.0, fy_px=500.0, cx_px=320.0, cy_px=240.0)
LIGHTS_M = np.array([[-0.2, 0.13, 0.0], [0.2, 0.13, 0.0], [0.2, -0.13, 0.0], [-0.2, -0.13, 0.0]])
NOISE_PX = 0.2
DISTANCE_M = 0.8
VIEWS = 200
TILTS_DEG = (10.0, 30.0, 50.0)


def direct_pose(points_m: Array, pixels: Array, camera: CameraIntrinsics) -> tuple[Array, Array]:
    """Return the (3, 3) rotation and (3,) translation camera_from_object by the paper's method.

    Args:
        points_m: (4, 3) corners of any quadrangle, of which the first three are not on one line.
        pixels: (4, 2) measured pixels, in the same order.

    Raises:
        NotFound: no pose projects the first three lights to their pixels.
    """
    matrix = np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])
    count, turns, shifts = cv2.solveP3P(
        points_m[:3], pixels[:3], matrix, np.array(camera.distortion), flags=cv2.SOLVEPNP_P3P
    )
    poses = [(cv2.Rodrigues(turn)[0], np.asarray(shift).ravel()) for turn, shift in zip(turns, shifts, strict=True)]
    if not count:
        raise NotFound("no pose puts the first three lights on their pixels", hint="check the order of the lights")

    def fourth_error_px(pose: tuple[Array, Array]) -> float:
        rotation, translation_m = pose
        return float(np.linalg.norm(project((rotation @ points_m[3] + translation_m)[None], camera)[0] - pixels[3]))

    return min(poses, key=fourth_error_px)


def errors(tilt_deg: float, seed: int) -> Array:
    """Return (VIEWS, 4) errors: rotation (deg) of the direct pose and of ours, then position (mm) of both.

    Views in which one of the two finds the mirror pose are left out, so there may be fewer rows.
    """
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(VIEWS):
        azimuth = rng.uniform(0.0, 2.0 * np.pi)
        axis = np.deg2rad(tilt_deg) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        rotation = Rotation.from_rotvec(axis).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        translation_m = np.array([*rng.uniform(-0.05, 0.05, 2), DISTANCE_M])
        pixels = project(LIGHTS_M @ rotation.T + translation_m, CAMERA) + rng.normal(0.0, NOISE_PX, (4, 2))
        ours = estimate(LIGHTS_M, pixels, NOISE_PX**2, CAMERA)
        pairs = [direct_pose(LIGHTS_M, pixels, CAMERA), (ours.rotation, ours.translation_m)]
        turns = [float(np.rad2deg(Rotation.from_matrix(R @ rotation.T).magnitude())) for R, _ in pairs]
        if max(turns) < 0.7 * tilt_deg:
            found.append([*turns, *(1e3 * float(np.linalg.norm(t - translation_m)) for _, t in pairs)])
    return np.array(found)


def table(tilts_deg: Sequence[float] = TILTS_DEG, seed: int = 1990) -> list[tuple[float, Array]]:
    """Return the root mean square of `errors` for every tilt."""
    return [(tilt_deg, np.sqrt(np.mean(errors(tilt_deg, seed) ** 2, axis=0))) for tilt_deg in tilts_deg]


def main() -> None:
    """Print the table."""
    print(f"four lights, {VIEWS} views a row, {NOISE_PX} px noise, {DISTANCE_M} m; root mean square errors")
    print("tilt, deg    paper: deg     mm     ours: deg     mm     paper / ours")
    for tilt_deg, (turn, our_turn, place, our_place) in table():
        print(
            f"{tilt_deg:9.0f} {turn:13.3f} {place:6.2f} {our_turn:13.3f} {our_place:6.2f}"
            f" {turn / our_turn:10.2f}, {place / our_place:.2f}"
        )


if __name__ == "__main__":
    main()
