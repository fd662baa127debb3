"""Tests of the zero of a proximity sensor: a tilted beam, the stated uncertainty, and readings that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hal.arrays import Array
from hal.calibration import MountRecord, load_calibration
from hal.errors import NotObservable
from perception.calibration.zero import calibrate_zero
from service.cli import _app
from service.terminal import ROOT

TIP = MountRecord(position_m=(0.0, 0.0, 0.21), rpy_rad=(0.0, 0.0, 0.0), sigma_m=(0.0, 0.0, 0.0002))
BLOCKS_M = np.array([0.03, 0.05, 0.08])
Z_M = 0.162


def mount(roll_rad: float = 0.0) -> MountRecord:
    return MountRecord(position_m=(-0.02, 0.022, 0.15), rpy_rad=(roll_rad, 0.0, 0.0))


def readings_m(distances_m: Array, roll_rad: float = 0.0) -> Array:
    """Return how far a beam at Z_M, turned by `roll_rad`, has to the plate: the plane z = tip + distance."""
    return np.asarray((TIP.position_m[2] + distances_m - Z_M) / np.cos(roll_rad))


@pytest.mark.parametrize("roll_rad", [0.0, 0.3])
def test_exact_readings_give_the_zero_also_of_a_turned_beam(roll_rad: float) -> None:
    found = calibrate_zero(BLOCKS_M, readings_m(BLOCKS_M, roll_rad), mount=mount(roll_rad), tip=TIP)
    assert found.z_m == pytest.approx(Z_M, abs=1e-12) and found.scale == pytest.approx(1.0)


def test_the_stated_sigma_is_that_of_repeated_calibrations() -> None:
    random = np.random.default_rng(4)
    places_m = np.tile(BLOCKS_M, 4)
    off, stated = [], []
    for _ in range(300):
        noisy = readings_m(places_m) + 0.001 * random.standard_normal(len(places_m))
        tip_z_m = TIP.position_m[2] + TIP.sigma_m[2] * random.standard_normal()
        tip = TIP.model_copy(update={"position_m": (0.0, 0.0, float(tip_z_m))})
        found = calibrate_zero(places_m, noisy, mount=mount(), tip=tip)
        off.append(found.z_m - Z_M)
        stated.append(found.sigma_m)
    assert 0.8 < np.std(off) / np.mean(stated) < 1.2


def test_readings_that_do_not_give_the_zero_are_refused() -> None:
    for distances_m in (BLOCKS_M[:2], np.array([0.03, 0.031, 0.032])):
        with pytest.raises(NotObservable, match="do not give the zero"):
            calibrate_zero(distances_m, readings_m(distances_m), mount=mount(), tip=TIP)
    for wrong_m in (100.0 * readings_m(BLOCKS_M), readings_m(BLOCKS_M)[::-1]):
        with pytest.raises(NotObservable, match="the readings grow"):
            calibrate_zero(BLOCKS_M, wrong_m, mount=mount(), tip=TIP)


def test_the_command_writes_the_sensor_s_record_and_takes_it_off_the_list(tmp_path: Path) -> None:
    record, gripper = tmp_path / "proximity_left.toml", tmp_path / "gripper.toml"
    guessed = (ROOT / "cells/calibrations/proximity_left.toml").read_text()
    record.write_text(guessed.replace("[mount]", 'to_measure = ["mount"]\n\n[mount]'))
    gripper.write_text((ROOT / "cells/real-ur10e/gripper.toml").read_text())
    rows = [f"{d:.4f} {r:.4f}" for d, r in zip(BLOCKS_M, readings_m(BLOCKS_M), strict=True)]
    (tmp_path / "left.txt").write_text("# distance reading\n" + "\n".join(rows) + "\n")
    words = ["calibrate", "zero", str(tmp_path / "left.txt"), "--out", str(record), "--gripper", str(gripper)]
    done = CliRunner().invoke(_app(), words)
    assert done.exit_code == 0, done.output
    after = load_calibration(record)
    assert after.mount is not None and after.to_measure == () and after.version == 2
    assert after.mount.position_m == pytest.approx((-0.02, 0.022, Z_M), abs=1e-4)
    grip = load_calibration(gripper).mount
    assert grip is not None and after.mount.sigma_m[2] > grip.sigma_m[2]
