"""What is in a recording, by the `mcap` package's own reader and decoder."""

from __future__ import annotations

import io
import json
import os
import pickle
import signal
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from PIL import Image as PillowImage

from hal.config import load_cell
from hal.errors import ConfigError
from hal.simulated import Fault
from service.core import Service
from service.recording.reader import open_recording
from service.recording.sender import MOST_ROWS, Dropped, Sender
from tests.service.conftest import WriteCell
from tests.service.recording.conftest import run, running
from tests.service.recording.looks import OPERATIONS


def messages(path: Path) -> dict[str, list[Any]]:
    """Return all messages by topic, decoded by the schemas in the file."""
    found: dict[str, list[Any]] = defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            is_json = channel.message_encoding == "json"
            decoder = json.loads if is_json else DecoderFactory().decoder_for("protobuf", schema)
            assert schema.encoding == ("jsonschema" if is_json else "protobuf")
            assert decoder is not None
            found[channel.topic].append(decoder(message.data))
    return found


def test_everything_that_was_read_and_commanded_is_in_the_file(looked: Path) -> None:
    found = messages(looked)
    states, targets = found["/control/arm/read_state"], found["/control/arm/command_position"]
    assert len(targets) > 50  # 0.4 s and more at 250 Hz
    assert all(len(one.position_rad) == 6 and one.quality == "valid" for one in states)
    assert targets[-1].wanted_rad[0] == pytest.approx(0.1, abs=1e-3)
    assert [one.sequence for one in states] == sorted({one.sequence for one in states})
    assert {len(one.force_n) for one in found["/control/wrist_ft/read_wrench"]} == {3}
    assert found["/control/finger_touch/read_contacts"] and found["/control/gripper/read_state"]
    by_task = [call for call in found["/calls/cell.mover"] if call["method"] == "execute"]
    assert [call["arguments"][0]["name"] for call in by_task] == ["turn", "open", "settle"]
    assert found["/calls/panel_lights"][0]["arguments"] == [[True, False, True, False]]


def test_foxglove_finds_images_joints_frames_and_the_log(looked: Path) -> None:
    found = messages(looked)
    image, call = found["/wrist_camera/image"][0], found["/calls/wrist_camera"][0]
    assert call["value"]["value"]["pixels"] == {"$picture": {"topic": "/wrist_camera/image", "sequence": 1}}
    assert np.asarray(PillowImage.open(io.BytesIO(image.data))).shape == (48, 64, 3)
    assert found["/range_scanner/points"][0].point_stride == 12
    assert [joint.name for joint in found["/joint_states"][0].joints] == [f"arm_{k}" for k in range(1, 7)]
    children = {(one.parent_frame_id, one.child_frame_id) for one in found["/tf"][0].transforms}
    assert {("base", "flange"), ("flange", "wrist_camera")} <= children
    assert any("look" in line.message and line.name == "task-queued" for line in found["/log"])


def test_the_file_says_which_cell_it_is_and_holds_it(looked: Path, tmp_path: Path) -> None:
    recording = open_recording(looked)
    assert (recording.about["cell"], recording.about["seed"], recording.about["mode"]) == ("fake", "3", "sim")
    cell = recording.unpack(tmp_path / "unpacked")
    assert (cell.name, cell.file.cell.seed, len(cell.panel.lights)) == ("fake", 3, 4)
    assert cell.path.parent == tmp_path / "unpacked"
    task = recording.tasks[0]
    assert (task.verb, task.state, task.request["looks"]) == ("look", "succeeded", 2)
    assert not recording.is_cut


def test_a_recording_that_was_cut_off_is_read_up_to_the_cut(looked: Path, tmp_path: Path) -> None:
    whole, cut = looked.read_bytes(), tmp_path / "cut.mcap"
    lengths = []
    for part in (0.999, 0.9, 0.7):
        cut.write_bytes(whole[: int(part * len(whole))])
        try:
            recording = open_recording(cut)
        except ConfigError as error:
            assert "cut off" in error.what
            continue
        assert recording.is_cut
        lengths.append(sum(len(task.calls) for task in recording.tasks))
    assert lengths == sorted(lengths, reverse=True)
    assert lengths[0] > 0


@pytest.mark.parametrize("content", [b"", b"no recording", b"\x89MCAP0\r\n"])
def test_a_file_that_is_no_recording_is_refused_by_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"other\.mcap is not a recording"):
        open_recording(path)


def test_what_was_flushed_survives_the_death_of_the_recorder(write_cell: WriteCell, tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    cell = load_cell(write_cell(robot=True))
    with running(Service(cell, OPERATIONS, runs_dir=tmp_path / "runs", inline=True, record=path)) as service:
        run(service, "look")
        process = service.recording._process  # type: ignore[union-attr]  # it records
        process.proxy("recorder").flush()
        os.kill(process.pid or 0, signal.SIGKILL)
        process.await_end()
        assert run(service, "look").state == "succeeded"  # the cell goes on without its recorder
    recording = open_recording(path)
    assert recording.is_cut
    assert len(recording.tasks) == 1
    assert len(recording.tasks[0].calls) > 0


def test_an_existing_file_is_not_overwritten(write_cell: WriteCell, tmp_path: Path) -> None:
    path = tmp_path / "precious.mcap"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="exists already"):
        Service(load_cell(write_cell()), OPERATIONS, runs_dir=tmp_path / "runs", inline=True, record=path)
    assert path.read_text() == "precious"


def test_errors_of_devices_are_recorded_and_the_journal_still_has_everything(
    write_cell: WriteCell, tmp_path: Path
) -> None:
    path = tmp_path / "session.mcap"
    cell = load_cell(write_cell(options={"wrist_camera": {}}, robot=True))
    with running(Service(cell, OPERATIONS, runs_dir=tmp_path / "runs", inline=True, record=path)) as service:
        service.supervisor.connection.device("finger_proximity").inject_fault(Fault.SILENT)
        assert run(service, "measure").state == "failed"
        kinds = [record.kind for record in service.journal.records(limit=100)]
    assert {"task-queued", "task-ended"} <= set(kinds)
    call = next(c for c in messages(path)["/calls/finger_proximity"] if c["method"] == "read_distance_m")
    assert call["error"]["class"] == "hal.errors.DeviceTimeout"
    assert call["value"] is None


def test_a_slow_recorder_costs_readings_which_are_counted_and_nothing_else() -> None:
    is_open, batches = threading.Event(), []

    def take(batch: bytes) -> str:
        is_open.wait(30.0)
        batches.append(batch)
        return ""

    sender = Sender(take, report=lambda _kind, _data: None)
    for k in range(MOST_ROWS + 200):
        sender.put_row((0, 0.0, 0.0, None, (k,)))
    sender.put("a call")
    is_open.set()
    sender.close()
    items = [item for batch in batches for item in pickle.loads(batch)]  # noqa: S301 - our own rows
    lost = sum(item.rows for item in items if isinstance(item, Dropped))
    assert lost + sum(isinstance(item, tuple) for item in items) == MOST_ROWS + 200
    assert 0 < lost <= 200
    assert "a call" in items


def test_what_the_control_loop_does_before_the_cell_is_described_follows_the_description() -> None:
    """In a cell on the wall's clock the control loop reads its devices while the others are still being described."""
    batches: list[bytes] = []

    def take(batch: bytes) -> str:
        batches.append(batch)
        return ""

    sender = Sender(take, report=lambda _kind, _data: None, waits=True)
    sender.put_row((0, 0.0, 0.0, None, (1,)))
    sender._send_waiting()  # what its thread does every 20 ms
    assert batches == []
    sender.begin("the cell")
    sender.close()
    items = [item for batch in batches for item in pickle.loads(batch)]  # noqa: S301 - our own rows
    assert items == ["the cell", (0, 0.0, 0.0, None, (1,))]
