"""Repeats the paper's Table II and Fig. 13: a pose that improves with each measurement although the first one is bad.

    python -m examples.paper.table2 [--seed N] [--out FOLDER]

Prints the paper's errors, those of plain least squares over all measurements (the paper's objective) and those of the
robust fusion, after each of the 16 measurements, and draws the first six poses.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from benchmarks.fusion_simulation import TABLE_II, Problem, problem
from examples.paper.outlines import Drawing, axes, box_outlines, circle_outline, sight_of
from fusion import Contradiction, FusedPose, fuse, solve_from_many
from hal.arrays import Array
from hal.geometry import difference

# Table II: local pose function of the added measurement at the true pose, error in inches, error in degrees.
PAPER = (
    (321.0, 7.14, 168.0), (0.41, 10.8, 97.5), (0.11, 4.27, 156.0), (0.004, 2.70, 75.8), (0.48, 2.52, 39.1),
    (0.59, 2.17, 2.18), (0.002, 2.16, 2.06), (0.49, 1.50, 3.80), (0.35, 1.49, 3.73), (0.06, 1.46, 3.82),
    (0.10, 1.46, 3.82), (1.38, 1.46, 3.57), (0.004, 0.98, 3.24), (0.01, 0.84, 2.85), (1.10, 0.78, 1.37), (0.49, 0.63, 0.63),
)  # fmt: skip
INCH_MM = 25.4


def outlines() -> list[Array]:
    """Return the edges of the simulated panel and its block, and the six lights, which show where the front is."""
    lights = [circle_outline((x, y, 0.0), 0.015) for x in (0.05, 0.4, 0.75) for y in (0.05, 0.45)]
    return [*box_outlines((0, 0, -0.1), (0.8, 0.5, 0)), *box_outlines((0.1, 0.1, 0), (0.35, 0.3, 0.06)), *lights]


def robust(made: Problem, count: int) -> FusedPose | None:
    """Return the robust fusion of the first `count` measurements, or None if it refuses."""
    try:
        return fuse(made.measurements[:count])
    except Contradiction:
        return None


def errors(true: RigidTransform, pose: RigidTransform) -> tuple[float, float]:
    """Return the position error in mm and the rotation error in degrees."""
    delta = difference(true, pose)
    return 1e3 * float(np.linalg.norm(delta[:3])), float(np.degrees(np.linalg.norm(delta[3:])))


def remark(answer: FusedPose | None) -> str:
    """Return what the fusion reports: free directions, rejected measurements, alternatives, or its refusal."""
    if answer is None:
        return "refused: no set of measurements agrees by more than chance"
    notes = [f"free: {free.words}" for free in answer.unobservable]
    named = ", ".join(f"{r.index + 1} ({r.value:.0f})" for r in answer.rejected)
    notes += [f"not believed: {named}"] if named else []
    notes += [f"also possible: {a.odds:.1g}" for a in answer.alternatives[:2]]
    return "; ".join(notes)


def table(made: Problem) -> list[str]:
    """Return one line of the table per added measurement."""
    lines = [
        " n data |    paper         |  least squares    |     robust         | what it says",
        "        |     mm      deg  |     mm      deg   |     mm      deg    |",
    ]
    for n, code in enumerate(TABLE_II, 1):
        _, inches, degrees = PAPER[n - 1]
        plain = errors(made.base_from_object, solve_from_many(made.measurements[:n], starts=32).base_from_object)
        answer = robust(made, n)
        ours = errors(made.base_from_object, answer.pose) if answer and not answer.unobservable else None
        shown = f"{ours[0]:8.2f} {ours[1]:8.3f}" if ours else f"{'-':>8} {'-':>8}"
        lines.append(
            f"{n:2d} {code}{'*' if n == 1 else ' '}  | {inches * INCH_MM:7.1f} {degrees:7.2f}  | {plain[0]:8.2f} "
            f"{plain[1]:8.3f} | {shown}  | {remark(answer)}"
        )
    return lines


def draw(made: Problem, folder: Path) -> None:
    """Draw figure 13: actual pose (dashed), least squares and robust fusion after each of the first 6 measurements."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    sight = sight_of(made.base_from_object, (0.4, 0.25, 0.0), distance_m=1.6)
    figure = Figure(figsize=(12, 7), layout="constrained")
    for n, ax in enumerate(figure.subplots(2, 3).ravel(), 1):
        drawings = poses_after(made, n)
        title = f"after {n} measurement{'s' if n > 1 else ''}"
        axes(ax, drawings, sight, title=title)
    named = dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=3)
    figure.savefig(folder / "figure13.png", dpi=110)


def poses_after(made: Problem, n: int) -> list[Drawing]:
    """Return the drawings of Fig. 13 after n measurements."""
    lines = outlines()
    plain = solve_from_many(made.measurements[:n], starts=32).base_from_object
    drawings = [
        Drawing(
            base_from_object=made.base_from_object, outlines_m=lines, colour="#444444", label="actual", dashed=True
        ),
        Drawing(base_from_object=plain, outlines_m=lines, colour="#d62728", label="least squares"),
    ]
    answer = robust(made, n)
    if answer is not None and not answer.unobservable:
        drawings.append(Drawing(base_from_object=answer.pose, outlines_m=lines, colour="#1f77b4", label="robust"))
    return drawings


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("runs/table2"), help="folder for the drawing [%(default)s]")
    args = parser.parse_args()
    made = problem(TABLE_II, np.random.default_rng(args.seed), bad=[0])
    print("\n".join(table(made)))
    draw(made, args.out)
    print(f"drawing: {args.out / 'figure13.png'}")


if __name__ == "__main__":
    main()
