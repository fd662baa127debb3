"""Tests of the tool centre point: exact and noisy touches, its covariance, and touches that do not determine it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation
from typer.testing import CliRunner

from hal.arrays import Array
from hal.calibration import load_calibration
from hal.errors import NotObservable
from perception.calibration.tip import calibrate_tip
from service.cli import _app
from service.terminal import ROOT

TIP, PIN = np.array([0.002, -0.001, 0.212]), np.array([0.6, -0.2, 0.1])
TURNS = Rotation.from_euler("xyz", [[3.1, 0, 0], [2.1, 0, 0.5], [3.1, 1.0, 1.5], [2.6, -0.8, 3.0], [2.4, 0.7, -1.0]])


def touches(noise_m: float = 0.0, seed: int = 0, turns: Rotation = TURNS) -> list[RigidTransform]:
    off = np.random.default_rng(seed).normal(scale=noise_m, size=(len(turns), 3)) if noise_m else np.zeros((1, 3))
    places: Array = PIN + off - turns.apply(TIP)
    return [RigidTransform.from_components(place, turn) for place, turn in zip(places, turns, strict=True)]


def test_exact_touches_give_the_tip_and_the_point() -> None:
    found = calibrate_tip(touches())
    np.testing.assert_allclose(found.flange_from_tip_m, TIP, atol=1e-12)
    np.testing.assert_allclose(found.touched_m, PIN, atol=1e-12)


def test_the_covariance_is_that_of_repeated_touches() -> None:
    stated, off = [], []
    for seed in range(300):
        found = calibrate_tip(touches(5e-4, seed))
        off.append(found.flange_from_tip_m - TIP)
        stated.append(found.covariance_m2)
    ratio = np.trace(np.cov(np.array(off).T)) / np.trace(np.mean(stated, axis=0))
    assert 0.8 < ratio < 1.2


def test_touches_that_do_not_determine_the_tip_are_refused() -> None:
    with pytest.raises(NotObservable, match="3 touches"):
        calibrate_tip(touches()[:3])
    about_one_axis = Rotation.from_euler("z", [[0.0], [1.0], [2.0], [3.0]])
    with pytest.raises(NotObservable, match="turned too little"):
        calibrate_tip(touches(turns=about_one_axis))
    with pytest.raises(NotObservable, match="scatter by"):
        calibrate_tip(touches(0.01, 1))


def test_the_command_writes_the_gripper_s_record_and_takes_it_off_the_list(tmp_path: Path) -> None:
    record = tmp_path / "gripper.toml"
    record.write_text((ROOT / "cells/real-ur10e/gripper.toml").read_text())
    rows = [" ".join(f"{v:.6f}" for v in (*pose.translation, *pose.rotation.as_rotvec())) for pose in touches(2e-4)]
    (tmp_path / "touches.txt").write_text("# X Y Z RX RY RZ\n" + "\n".join(rows) + "\n")
    done = CliRunner().invoke(_app(), ["calibrate", "tip", str(tmp_path / "touches.txt"), "--out", str(record)])
    assert done.exit_code == 0, done.output
    after = load_calibration(record)
    assert after.mount is not None and after.to_measure == () and after.version == 2
    np.testing.assert_allclose(after.mount.position_m, TIP, atol=1e-3)
    assert 1e-4 < max(after.mount.sigma_m) < 1e-3
