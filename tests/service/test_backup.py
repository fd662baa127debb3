"""A backup has every file with its hash; a restore gives the same bytes, or changes nothing and says everything that is wrong."""

from __future__ import annotations

import fcntl
import hashlib
import io
import os
import tarfile
from pathlib import Path

import pytest

from hal.errors import ConfigError
from service.access.keys import KeyBook, Role
from service.backup import MANIFEST, Manifest, backup, restore
from service.tasks.journal import Journal


def hashes_of(runs: Path) -> dict[str, str]:
    """Return the hash of each file except those of a running database."""
    return {
        path.relative_to(runs).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in runs.rglob("*")
        if path.is_file()
        and path.suffix not in (".lock",)
        and path.name != "lock"
        and not path.name.endswith(("-wal", "-shm"))
    }


def faults_of(file: Path, runs: Path) -> str:
    before = hashes_of(runs) if runs.exists() else None
    with pytest.raises(ConfigError) as caught:
        restore(file, runs)
    assert (hashes_of(runs) if runs.exists() else None) == before, "nothing was changed"
    assert not runs.with_name(f"{runs.name}.restoring").exists()
    return " | ".join(caught.value.details["faults"])


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Return the folder of a service that has ended, with a bit of everything."""
    runs = tmp_path / "runs"
    journal = Journal(runs / ".service" / "journal.sqlite", part_bytes=20_000)
    for number in range(60):
        journal.append("stop", {"number": number, "why": "x" * 200})
    KeyBook(runs / ".service" / "keys.json").add("alice", Role.OPERATOR, valid_s=None, commit=journal.append)
    journal.close()
    for name, data in {
        "images/a.png": os.urandom(5000),
        "knowledge/panels/p.toml": b"schema = 1\n",
        "m/report.json": b"{}",
    }.items():
        (runs / name).parent.mkdir(parents=True, exist_ok=True)
        (runs / name).write_bytes(data)
    return runs


@pytest.fixture
def saved(runs: Path, tmp_path: Path) -> Path:
    file = tmp_path / "cell.tar.gz"
    backup(runs, file)
    return file


def test_what_comes_back_has_the_same_hashes_and_permissions(runs: Path, saved: Path, tmp_path: Path) -> None:
    assert saved.stat().st_mode & 0o777 == 0o600
    manifest, aside = restore(saved, tmp_path / "elsewhere")
    back = hashes_of(tmp_path / "elsewhere")
    assert aside is None and back == {entry.path: entry.sha256 for entry in manifest.files}
    assert set(back) == set(hashes_of(runs))
    plain = {
        name for name in back if not name.endswith(".sqlite")
    }  # a copied database has the same rows in other pages
    assert {name: back[name] for name in plain} == {name: hashes_of(runs)[name] for name in plain}
    assert (tmp_path / "elsewhere/.service/keys.json").stat().st_mode & 0o777 == 0o600
    journal = Journal(tmp_path / "elsewhere" / ".service" / "journal.sqlite")
    assert journal.verify() == 61
    journal.close()
    assert backup(tmp_path / "elsewhere", tmp_path / "again.tar.gz").sha256() == manifest.sha256()


def test_what_was_there_is_renamed_and_not_deleted(runs: Path, saved: Path) -> None:
    (runs / "m" / "report.json").write_bytes(b"changed")
    _, aside = restore(saved, runs)
    assert aside is not None and (aside / "m/report.json").read_bytes() == b"changed"
    assert (runs / "m/report.json").read_bytes() == b"{}"
    _, other = restore(saved, runs)
    assert other not in (None, aside)


def test_a_backup_of_a_running_service_is_whole(runs: Path, tmp_path: Path) -> None:
    journal = Journal(runs / ".service" / "journal.sqlite", part_bytes=20_000)
    journal.append("stop", {"number": 61})
    backup(runs, tmp_path / "live.tar.gz")
    journal.append("stop", {"number": 62})
    journal.close()
    restore(tmp_path / "live.tar.gz", tmp_path / "elsewhere")
    restored = Journal(tmp_path / "elsewhere" / ".service" / "journal.sqlite")
    assert restored.verify() == 62
    restored.close()


def test_it_is_refused_while_a_service_runs_and_over_a_newer_journal(runs: Path, saved: Path) -> None:
    with (runs / ".service" / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert "a service runs" in faults_of(saved, runs)
    journal = Journal(runs / ".service" / "journal.sqlite")
    journal.append("stop", {})
    journal.close()
    assert "newer journal (row 62) than the backup (row 61)" in faults_of(saved, runs)


def rewritten(saved: Path, *, change: str = "", drop: str = "", add: str = "", version: str = "") -> Path:
    """Return a copy of a backup with one file changed, dropped or added, or of another version."""
    bad = saved.with_name("bad.tar.gz")
    with tarfile.open(saved) as source, tarfile.open(bad, "w:gz") as target:
        for info in source:
            data = source.extractfile(info)
            assert data is not None
            content = data.read()
            if info.name == MANIFEST and version:
                content = (
                    Manifest.model_validate_json(content)
                    .model_copy(update={"version": version})
                    .model_dump_json()
                    .encode()
                )
            if info.name.endswith(change) and change:
                content = content[:-1] + b"!"
            if drop and info.name.endswith(drop):
                continue
            put(target, info.name, content)
        if add:
            put(target, add, b"x")
    return bad


def put(target: tarfile.TarFile, name: str, content: bytes) -> None:
    info = tarfile.TarInfo(name)
    info.size = len(content)
    target.addfile(info, io.BytesIO(content))


def test_every_fault_of_a_damaged_backup_is_named_at_once(saved: Path, tmp_path: Path) -> None:
    told = faults_of(rewritten(saved, change="a.png", drop="p.toml", add="runs/more.txt"), tmp_path / "new")
    assert "images/a.png has another hash" in told
    assert "knowledge/panels/p.toml is missing" in told
    assert "more.txt is not in the backup's list" in told


@pytest.mark.parametrize("name", ["runs/../../evil", "/etc/evil", "evil", "runs/a/../../../evil"])
def test_nothing_is_written_outside_the_folder(saved: Path, tmp_path: Path, name: str) -> None:
    assert "is no file of a backup" in faults_of(rewritten(saved, add=name), tmp_path / "deep" / "new")
    assert not list(tmp_path.rglob("evil"))


def test_a_backup_of_a_newer_version_is_refused(saved: Path, tmp_path: Path) -> None:
    assert "install that version first" in faults_of(rewritten(saved, version="999.0"), tmp_path / "new")


def test_a_file_that_was_cut_off_or_is_something_else_is_refused(saved: Path, tmp_path: Path) -> None:
    data = saved.read_bytes()
    for cut in (data[: len(data) // 2], data[: -len(data) // 8], b"", b"no archive"):
        saved.write_bytes(cut)
        assert "no complete backup" in faults_of(saved, tmp_path / "new")


def test_a_backup_cannot_be_inside_what_it_saves(runs: Path) -> None:
    with pytest.raises(ConfigError, match="inside"):
        backup(runs, runs / "backup.tar.gz")
    with pytest.raises(ConfigError, match="no folder"):
        backup(runs / "none", runs.parent / "backup.tar.gz")
