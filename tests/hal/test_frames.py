"""The frames of a cell file place every mounted device by its record, in whatever order the mounts are listed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.config import Cell, load_cell
from hal.errors import ConfigError
from hal.frames import frame_tree
from hal.geometry import transform_rpy

BENCH = Path(__file__).parents[2] / "cells" / "bench.toml"
FLANGE = transform_rpy([0.4, -0.1, 0.5], [0.1, 0.2, 0.3])
MOUNTED = {"gripper", "wrist_camera", "range_scanner", "proximity_left", "proximity_right", "wrist_ft"}


def hung(cell: Cell, device: str, parent: str) -> Cell:
    """Return the cell with a device mounted on another frame."""
    section = cell.file.devices[device]
    assert section.mount is not None
    moved = section.model_copy(update={"mount": section.mount.model_copy(update={"parent": parent})})
    devices = {**cell.file.devices, device: moved}
    return cell.model_copy(update={"file": cell.file.model_copy(update={"devices": devices})})


def test_every_mounted_device_has_a_frame_where_its_record_says_with_its_covariance() -> None:
    cell = load_cell(BENCH)
    tree = frame_tree(cell, FLANGE)
    assert set(tree.names()) == MOUNTED | {"base", "flange"}
    for name in MOUNTED:
        mount = cell.calibration_of(name).mount
        assert mount is not None
        found, record = tree.pose("flange", name), mount.pose()
        np.testing.assert_allclose(
            found.parent_from_child.as_matrix(), record.parent_from_child.as_matrix(), atol=1e-12
        )
        np.testing.assert_allclose(found.covariance, record.covariance, atol=1e-15)
        expected = FLANGE * record.parent_from_child
        np.testing.assert_allclose(tree.base_from(name).parent_from_child.as_matrix(), expected.as_matrix(), atol=1e-12)


def test_a_device_on_a_device_that_comes_later_in_the_file_is_placed_on_it() -> None:
    cell = hung(load_cell(BENCH), "gripper", "wrist_ft")
    names = list(cell.file.devices)
    assert names.index("gripper") < names.index("wrist_ft")
    gripper, wrist = cell.calibration_of("gripper").mount, cell.calibration_of("wrist_ft").mount
    assert gripper is not None and wrist is not None
    expected = FLANGE * wrist.pose().parent_from_child * gripper.pose().parent_from_child
    found = frame_tree(cell, FLANGE).base_from("gripper").parent_from_child
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-12)


@pytest.mark.parametrize("parent", ["elbow", "gripper"])
def test_a_mount_on_nothing_or_on_itself_is_named_with_the_frames_that_there_are(parent: str) -> None:
    with pytest.raises(ConfigError, match=rf"devices\.gripper\.mount\.parent: no frame called '{parent}'") as caught:
        frame_tree(hung(load_cell(BENCH), "gripper", parent), FLANGE)
    assert caught.value.details["key"] == "devices.gripper.mount.parent"
    assert "flange" in caught.value.hint and "wrist_camera" in caught.value.hint
