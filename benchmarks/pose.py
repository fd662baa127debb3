"""Measures the four-light pose: errors against their bound, mirror poses, times, and other libraries.

python -m benchmarks.pose CASES.json OUT.json [--time]    solve a file of problems (schema of data/pose)
python -m benchmarks.pose [--quick]                       print the table, pass line beside measured value
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pose_cases import Problem, error, is_flipped, problems
from benchmarks.pose_hand_eye import rows as hand_eye_rows
from benchmarks.pose_lights import drawn_pairs, score_pairs, stored_pairs
from hal.arrays import Array
from hal.calibration import CameraIntrinsics
from hal.errors import CellError
from perception.vision.quadrangle import QuadranglePose, estimate, warm_up

ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])
DEVELOPMENT = Path(__file__).resolve().parents[2] / "shared" / "data" / "pose" / "dev_quads.json"
SHAPES = [
    "coplanar-300x200", "coplanar-700x400", "noncoplanar-300x200", "parallelogram", "one-right-angle", "irregular"
]  # fmt: skip


def camera_of(problem: Problem) -> CameraIntrinsics:
    """Return the problem's camera as the library's intrinsics."""
    K = problem["K"]
    return CameraIntrinsics(
        width_px=int(K["width"]), height_px=int(K["height"]), fx_px=K["fx"], fy_px=K["fy"], cx_px=K["cx"], cy_px=K["cy"]
    )


def solve(problem: Problem) -> tuple[QuadranglePose, float]:
    """Return the estimate and its time in milliseconds, from arrays to pose, covariance, alternatives and flag."""
    points, pixels = np.array(problem["points_obj"]), np.array(problem["points_img"])
    camera, variance = camera_of(problem), problem["sigma_px"] ** 2
    started_s = time.perf_counter()
    pose = estimate(points, pixels, variance, camera)
    return pose, (time.perf_counter() - started_s) * 1e3


def solution(problem: Problem, *, timed: bool) -> dict[str, Any]:
    """Return one answer in the schema of data/pose (rotation first)."""
    pose, ms = solve(problem)
    answer: dict[str, Any] = {
        "R": pose.rotation.tolist(),
        "t": pose.translation_m.tolist(),
        "cov": pose.covariance[np.ix_(ROTATION_FIRST, ROTATION_FIRST)].ravel().tolist(),
        "ambiguous": bool(pose.ambiguous),
        "alternatives": [{"R": a.rotation.tolist(), "t": a.translation_m.tolist()} for a in pose.alternatives],
    }
    return answer | {"ms": ms} if timed else answer


# --- peers -----------------------------------------------------------------------------------------------------------


def opencv(method: str) -> Callable[[Problem], tuple[Array, Array]]:
    """Return a solver that calls cv2.solvePnP with the named method, as users call it."""
    import cv2

    flag = getattr(cv2, f"SOLVEPNP_{method}")

    def run(problem: Problem) -> tuple[Array, Array]:
        ok, rotation, translation = cv2.solvePnP(
            np.array(problem["points_obj"]), np.array(problem["points_img"]), _matrix(problem), None, flags=flag
        )
        if not ok:
            raise ValueError("solvePnP gave up")
        return np.asarray(cv2.Rodrigues(rotation)[0], float), np.asarray(translation, float).ravel()

    return run


def poselib_robust(problem: Problem) -> tuple[Array, Array]:
    """Solve by poselib.estimate_absolute_pose with its refinement."""
    import poselib

    K = problem["K"]
    camera = {"model": "PINHOLE", "width": 1280, "height": 960, "params": [K["fx"], K["fy"], K["cx"], K["cy"]]}
    pose, _ = poselib.estimate_absolute_pose(
        np.array(problem["points_img"]), np.array(problem["points_obj"]), camera,
        {"max_reproj_error": 50.0, "max_error": 50.0}, {},
    )  # fmt: skip
    return np.array(pose.R), np.array(pose.t)


def gtsam_refined(problem: Problem) -> tuple[Array, Array]:
    """Solve by gtsam's Levenberg-Marquardt over projection factors with fixed landmarks, started from cv2's AP3P."""
    import gtsam

    K = problem["K"]
    calibration = gtsam.Cal3_S2(K["fx"], K["fy"], 0.0, K["cx"], K["cy"])
    noise = gtsam.noiseModel.Isotropic.Sigma(2, problem["sigma_px"])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start_R, start_t = opencv("AP3P")(problem)
    values.insert(0, gtsam.Pose3(gtsam.Rot3(start_R), start_t).inverse())
    for k, (point, pixel) in enumerate(zip(problem["points_obj"], problem["points_img"], strict=True), start=1):
        values.insert(k, np.array(point))
        graph.add(gtsam.NonlinearEqualityPoint3(k, np.array(point)))
        graph.add(gtsam.GenericProjectionFactorCal3_S2(np.array(pixel), noise, 0, k, calibration))
    pose = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize().atPose3(0).inverse()
    return np.asarray(pose.rotation().matrix(), float), np.asarray(pose.translation(), float)


def _matrix(problem: Problem) -> Array:
    K = problem["K"]
    return np.array([[K["fx"], 0.0, K["cx"]], [0.0, K["fy"], K["cy"]], [0.0, 0.0, 1.0]])


# --- figures ---------------------------------------------------------------------------------------------------------


def efficiency(cases: list[Problem], solver: Callable[[Problem], tuple[Array, Array]]) -> dict[str, float]:
    """Return the ratio of RMS error to bound (position, rotation), the fraction of flips and the median time.

    The ratios are for cases without flip whose bound is below 3 degrees.
    """
    position, rotation, flips, times_ms, failed = [], [], 0, [], 0
    for case in cases:
        started_s = time.perf_counter()
        try:
            R, t = solver(case)
        except Exception:  # a peer may raise any type; it counts as failed
            failed += 1
            continue
        times_ms.append((time.perf_counter() - started_s) * 1e3)
        if is_flipped(case, R):
            flips += 1
            continue
        bound = np.array(case["bound"])
        if np.degrees(np.sqrt(np.trace(bound[:3, :3]))) < 3.0:
            e = error(case, R, t)
            rotation.append(e[:3] @ e[:3] / np.trace(bound[:3, :3]))
            position.append(e[3:] @ e[3:] / np.trace(bound[3:, 3:]))
    return {
        "position": float(np.sqrt(np.mean(position))), "rotation": float(np.sqrt(np.mean(rotation))),
        "flips": flips / len(cases), "failed": failed / len(cases), "ms": float(np.median(times_ms)),
    }  # fmt: skip


def ours(case: Problem) -> tuple[Array, Array]:
    """Solve by this library."""
    pose, _ = solve(case)
    return pose.rotation, pose.translation_m


def consistency(cases: list[Problem]) -> float:
    """Return the mean NEES / 6 over the cases whose rotation bound is below 1 degree, without flips."""
    values = []
    for case in cases:
        bound = np.array(case["bound"])
        if np.degrees(np.sqrt(np.trace(bound[:3, :3]))) >= 1.0:
            continue
        pose, _ = solve(case)
        if not is_flipped(case, pose.rotation):
            e = error(case, pose.rotation, pose.translation_m)[ROTATION_FIRST]
            values.append(e @ np.linalg.solve(pose.covariance, e) / 6.0)
    return float(np.mean(values))


def mirrors(cases: list[Problem]) -> dict[str, float]:
    """Return the fractions of flips, flags, flips without flag, and cases with an unflipped answer or alternative."""
    rows = []
    for case in cases:
        pose, _ = solve(case)
        flipped = is_flipped(case, pose.rotation)
        listed = not flipped or any(not is_flipped(case, a.rotation) for a in pose.alternatives)
        rows.append((flipped, pose.ambiguous, flipped and not pose.ambiguous, listed, 1.0 - pose.probability))
    names = ("flips", "flagged", "unflagged", "listed", "predicted")
    return dict(zip(names, np.mean(np.array(rows, float), axis=0).tolist(), strict=True))


def table(*, quick: bool) -> Iterator[tuple[str, str, str]]:
    """Yield rows of (what, pass line, measured)."""
    n = 300 if quick else 2000
    warm_up()
    mixed = problems(
        11, n, shapes=SHAPES, tilt_deg=(0.0, 60.0), sigma_px=[0.1, 0.3, 1.0], range_m=[0.5, 1.0, 2.0]
    )  # fmt: skip
    tilted, frontal = (
        problems(seed, n, shapes=["coplanar-300x200"], tilt_deg=tilt, sigma_px=[1.0], range_m=[2.0])
        for seed, tilt in ((12, (5.0, 60.0)), (13, (0.0, 5.0)))
    )
    mine = efficiency(mixed, ours)
    yield "RMS / bound, position", "<= 1.05", f"{mine['position']:.3f}"
    yield "RMS / bound, rotation", "<= 1.05", f"{mine['rotation']:.3f}"
    yield "NEES / 6", "0.93-1.07", f"{consistency(mixed):.3f}"
    yield "time for minima, covariance, flag (median of mixed)", "<= 0.6 ms", f"{mine['ms']:.3f} ms"
    for name, cases, limit in (("5-60 deg", tilted, "<= 1.5 % at <= 15 %"), ("0-5 deg", frontal, "<= 5 %")):
        m = mirrors(cases)
        yield (
            f"unflagged mirrors at flagged, 1 px, 2 m, {name}", limit,
            f"{m['unflagged']:.2%} at {m['flagged']:.1%} (flips {m['flips']:.1%}, predicted {m['predicted']:.1%}, "
            f"listed {m['listed']:.1%})",
        )  # fmt: skip
    yield from _peer_rows(mixed[: n // 3])
    yield from _light_rows(quick=quick)
    yield from hand_eye_rows(5 if quick else 40)


def _peer_rows(cases: list[Problem]) -> Iterator[tuple[str, str, str]]:
    flat = [case for case in cases if not case["cell"].startswith("noncoplanar")]
    peers: list[tuple[str, Callable[[Problem], tuple[Array, Array]], list[Problem]]] = [
        ("cv2 IPPE (coplanar only)", opencv("IPPE"), flat), ("cv2 SQPNP", opencv("SQPNP"), cases),
        ("cv2 AP3P", opencv("AP3P"), cases), ("poselib robust + refine", poselib_robust, cases),
        ("gtsam LM from AP3P", gtsam_refined, cases[: len(cases) // 4]),
    ]  # fmt: skip
    for name, solver, theirs in peers:
        p, mine = efficiency(theirs, solver), efficiency(theirs, ours)
        yield (
            f"peer {name}", "-",
            f"RMS / bound {p['position']:.2f} pos {p['rotation']:.2f} rot, flips {p['flips']:.1%}, failed "
            f"{p['failed']:.1%}, {p['ms']:.3f} ms; ratio theirs / ours {p['position'] / mine['position']:.2f} pos, "
            f"{p['rotation'] / mine['rotation']:.2f} rot, {p['ms'] / mine['ms']:.2f} time",
        )  # fmt: skip


def _light_rows(*, quick: bool) -> Iterator[tuple[str, str, str]]:
    count = 20 if quick else 60
    for stress, line in ((False, ">= 95 %"), (True, ">= 85 %")):
        name = "stress" if stress else "bright"
        for source, pairs in (("stored", stored_pairs(stress=stress)), ("drawn", drawn_pairs(count, stress=stress))):
            yield f"light pairs all right, {name}, {source}", line, score_pairs(pairs)


def development_rows() -> list[tuple[str, str, str]]:
    """Return the same figures for the stored development problems, if they exist."""
    if not DEVELOPMENT.exists():
        return [("development problems", "-", "not found beside the repository")]
    cases = json.loads(DEVELOPMENT.read_text())["problems"]
    for case in cases:
        upper = np.zeros((6, 6))
        upper[np.triu_indices(6)] = case["crlb"]["cov"]
        case["bound"] = upper + upper.T - np.diag(np.diag(upper))
    mine, mirror = efficiency(cases, ours), mirrors(cases)
    return [
        ("development set: RMS / bound pos, rot", "<= 1.05", f"{mine['position']:.3f}, {mine['rotation']:.3f}"),
        ("development set: NEES / 6", "0.93-1.07", f"{consistency(cases):.3f}"),
        ("development set: unflagged mirrors at flagged", "-", f"{mirror['unflagged']:.2%} at {mirror['flagged']:.1%}"),
    ]


def main() -> None:
    """Run the command line; see the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="?", type=Path)
    parser.add_argument("out", nargs="?", type=Path)
    parser.add_argument("--time", action="store_true", help="add milliseconds to every answer")
    parser.add_argument("--quick", action="store_true", help="a tenth of the simulated problems")
    arguments = parser.parse_args()
    if arguments.cases is None:
        for what, line, measured in chain(development_rows(), table(quick=arguments.quick)):
            print(f"{what:<55} {line:<22} {measured}", flush=True)
        return
    if arguments.out is None:
        parser.error("give OUT.json too")
    warm_up()
    cases = json.loads(arguments.cases.read_text())["problems"]
    answers, refused = {}, 0
    for case in cases:
        try:
            answers[case["id"]] = solution(case, timed=arguments.time)
        except CellError as error:
            refused += 1
            print(f"{case['id']}: {error.what}")
    arguments.out.write_text(json.dumps(answers))
    print(f"{len(answers)} problems solved, {refused} refused")


if __name__ == "__main__":
    main()
