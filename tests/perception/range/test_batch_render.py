"""Tests of recordings, batches, rendered pictures, and images from points and features."""

from __future__ import annotations

import json
import os
import signal

import cv2
import distributed
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from hal.errors import ConfigError, InvalidRequest, NotFound
from perception.range import analyse
from perception.range.batch import analyse_files, batch_range, recordings_in, tasks_of
from perception.range.batch_results import write_results
from perception.range.from_points import image_from_points
from perception.range.recordings import Reading, assumptions, load_recording
from perception.range.render import MARK, picture, scene_json, write_ply, write_png
from perception.range.sensor import PinholeSensor
from tests.perception.range.scenes import PINHOLE, ball_on_table, noisy

META = {"unit": "m", "sensor": {"kind": "pinhole", "shape": [120, 160], "f": 180.0, "cx": 79.5, "cy": 59.5}}


def save(path, depth, meta=None):
    np.savez(path, depth=depth.astype(np.float32), meta=np.array(json.dumps(meta or META)))


@pytest.fixture
def folder(tmp_path):
    for k in range(5):
        save(tmp_path / f"scan_{k}.npz", noisy(ball_on_table().depth_m, 0.0005, seed=k))
    save(tmp_path / "scan_9_empty.npz", np.full((120, 160), np.nan))
    return tmp_path


def test_recordings_read_back(tmp_path):
    depth = ball_on_table().depth_m
    save(tmp_path / "a.npz", depth)
    read, sensor = load_recording(tmp_path / "a.npz")
    np.testing.assert_allclose(read, depth, rtol=1e-6)
    assert sensor == PINHOLE
    raw = np.where(np.arange(160) < 5, 0, np.rint(depth * 1000)).astype(np.uint16)
    (tmp_path / "b.png").write_bytes(cv2.imencode(".png", raw)[1].tobytes())
    read, _ = load_recording(tmp_path / "b.png")
    assert np.isnan(read[:, :5]).all() and np.nanmax(np.abs(read - depth)) < 0.00051


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "x.npz").write_bytes(b"nothing")
    (tmp_path / "x.png").write_bytes(b"nothing")
    for name in ("x.npz", "x.png", "missing.npz"):
        with pytest.raises(InvalidRequest):
            load_recording(tmp_path / name)


def test_the_reason_of_a_refusal_names_what_is_wrong_with_the_file(tmp_path):
    depth = np.full((20, 30), 0.8)
    np.savez(tmp_path / "other.npz", a=depth)
    cv2.imwrite(str(tmp_path / "colour.png"), np.zeros((20, 30, 3), np.uint8))
    whole = cv2.imencode(".png", np.arange(600, dtype=np.uint16).reshape(20, 30))[1].tobytes()
    (tmp_path / "cut.png").write_bytes(whole[: len(whole) // 2])
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000, 10000000), }".ljust(117) + b"\n"
    (tmp_path / "huge.npy").write_bytes(b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header)
    for name, why in (
        ("other.npz", "holds a, and neither depth nor u8"),
        ("colour.png", "3 channels"),
        ("cut.png", "not all of it is there"),
        ("huge.npy", "Unable to allocate"),
        ("", "is a folder"),
    ):
        with pytest.raises(InvalidRequest, match=why):
            load_recording(tmp_path / name)


def test_an_npz_of_depth_alone_is_a_bare_image_and_k_may_be_the_matrix(tmp_path):
    depth, matrix = np.full((20, 30), 0.8), np.array([[50.0, 0.0, 15.0], [0.0, 51.0, 10.0], [0.0, 0.0, 1.0]])
    np.savez(tmp_path / "bare.npz", depth=depth)
    np.savez(tmp_path / "matrix.npz", depth=1000.0 * depth, K=matrix)
    np.testing.assert_array_equal(load_recording(tmp_path / "bare.npz")[0], depth)
    assert "no sensor is given" in assumptions(tmp_path / "bare.npz", Reading())[0]
    assert not assumptions(tmp_path / "matrix.npz", Reading())
    metres, sensor = load_recording(tmp_path / "matrix.npz")
    np.testing.assert_allclose(metres, depth)
    assert (sensor.fx_px, sensor.fy_px, sensor.cx_px, sensor.cy_px) == (50.0, 51.0, 15.0, 10.0)


def test_tasks_hold_at_least_the_wanted_number(tmp_path):
    paths = [tmp_path / f"{k}.npz" for k in range(57)]
    groups = tasks_of(paths)
    assert min(len(g) for g in groups) >= 20
    assert [p for g in groups for p in g] == [str(p) for p in paths]


def test_a_bad_recording_costs_only_itself(folder):
    results = analyse_files([str(p) for p in recordings_in(folder)])
    assert [r.error is None for r in results] == [True] * 5 + [False]
    assert "NotFound" in results[-1].error
    write_results(folder / "out.jsonl", results)
    assert len((folder / "out.jsonl").read_text(encoding="utf-8").splitlines()) == 6


@pytest.mark.slow
def test_the_batch_is_the_same_for_one_and_two_workers(folder):
    plain = analyse_files([str(p) for p in recordings_in(folder)])
    seen = []
    for workers in (1, 2):
        assert batch_range(folder, workers=workers, progress=lambda done, total: seen.append((done, total))) == plain
    assert seen[-1] == (6, 6)


def _shut_out(worker_pids, seen):
    """Progress callback that kills one worker process as soon as a task is done."""

    def progress(done, total):
        if not seen:
            os.kill(worker_pids[0], signal.SIGKILL)
        seen.append((done, total))

    return progress


@pytest.mark.slow
def test_a_lost_worker_costs_nothing_but_time(tmp_path):
    for k in range(80):
        save(tmp_path / f"scan_{k:02d}.npz", noisy(ball_on_table().depth_m, 0.0005, seed=k % 4))
    plain = analyse_files([str(p) for p in recordings_in(tmp_path)])
    seen: list[tuple[int, int]] = []
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1"
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = list(client.run(os.getpid).values())
        result = batch_range(tmp_path, scheduler=cluster.scheduler_address, progress=_shut_out(pids, seen))
        with pytest.raises(ProcessLookupError):
            os.kill(pids[0], 0)
    assert result == plain
    assert seen[0][0] > 0, "the worker died after a task, not before the first"
    assert seen[-1] == (80, 80)


@pytest.mark.slow
def test_a_scheduler_without_workers_is_refused_in_time(folder, monkeypatch):
    monkeypatch.setattr("hal.workers.LOOK_S", 0.2)
    with (
        distributed.LocalCluster(n_workers=0, dashboard_address="127.0.0.1:0", host="127.0.0.1") as cluster,
        pytest.raises(ConfigError, match="no workers"),
    ):
        batch_range(folder, scheduler=cluster.scheduler_address)


def test_a_defect_on_one_recording_costs_only_itself(folder, monkeypatch):
    def broken(depth, sensor):
        raise ZeroDivisionError("a defect")

    monkeypatch.setattr("perception.range.batch.analyse", broken)
    results = analyse_files([str(p) for p in recordings_in(folder)])
    assert {r.error for r in results} == {"Defect: ZeroDivisionError: a defect"}


def test_drawn_pictures_are_no_recordings(folder):
    (folder / f"scan_0{MARK}.png").write_bytes(b"a picture")
    assert not [p for p in recordings_in(folder) if MARK in p.name]


def test_empty_folders_and_wrong_schedulers_are_refused(tmp_path, folder):
    with pytest.raises(InvalidRequest):
        recordings_in(tmp_path / "missing")
    with pytest.raises(ConfigError):
        batch_range(folder, scheduler="somewhere")


def test_json_picture_and_point_cloud(tmp_path):
    depth = noisy(ball_on_table().depth_m, 0.0005, seed=1)
    depth[:4] = np.nan
    scene = analyse(depth, PINHOLE)
    document = json.loads(json.dumps(scene_json(scene)))
    assert {s["type"] for s in document["surfaces"]} == {"plane", "sphere", "cylinder"}
    assert picture(scene).shape == (480, 640, 3)
    write_png(tmp_path / "a.png", scene)
    assert cv2.imread(str(tmp_path / "a.png")).shape == (480, 640, 3)
    write_ply(tmp_path / "a.ply", scene, depth)
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n", 1)
    assert f"element vertex {116 * 160}".encode() in head and len(body) == 116 * 160 * 15


def test_the_points_of_a_sweep_become_a_plane_in_the_base_frame():
    """A scanner on the wrist moves along y and looks down on a slab; every scan has its own arm pose."""
    rng = np.random.default_rng(0)
    angles = np.linspace(-0.4, 0.4, 181)
    down = Rotation.from_matrix(np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]]))
    scans = []
    beams = np.stack([np.sin(angles), np.zeros(181), np.cos(angles)], axis=1)
    for k, y in enumerate(np.linspace(-0.2, 0.2, 161)):
        height = 0.6 + 0.02 * np.sin(k / 10)
        ranges = (height - 0.1) / np.cos(angles) + rng.normal(0, 0.0004, angles.shape)
        pose = RigidTransform.from_components([0.3, y, height], down)
        scans.append(pose.apply(ranges[:, None] * beams))
    points = np.concatenate(scans)
    view = RigidTransform.from_components([0.3, 0.0, 0.6], down)
    sensor = PinholeSensor(width_px=120, height_px=110, fx_px=150.0, fy_px=150.0, cx_px=59.5, cy_px=54.5)
    plane = analyse(image_from_points(points, view, sensor), sensor).largest_plane()
    normal = view.rotation.apply(plane.primitive.normal)
    assert np.degrees(np.arccos(normal @ [0, 0, 1])) < 0.1
    assert view.apply(plane.primitive.point_m)[2] == pytest.approx(0.1, abs=0.0005)


def test_an_image_of_points_shows_the_nearest_in_each_pixel_and_needs_one():
    here = RigidTransform.identity()
    depth_m = image_from_points(
        np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.7], [0.1, 0.0, 1.0], [0.0, 0.0, -1.0]]), here, PINHOLE
    )
    assert sorted(depth_m[np.isfinite(depth_m)]) == [0.7, 1.0]
    for unseen in (np.empty((0, 3)), np.array([[0.0, 0.0, -1.0], [90.0, 0.0, 1.0]])):
        with pytest.raises(NotFound):
            image_from_points(unseen, here, PINHOLE)
