"""Backups of a service's folder: one file with everything and the SHA-256 hash of each part, and the way back.

Databases are copied by SQLite at one moment, also while a service runs. A restore checks everything before it changes
anything, deletes nothing, and puts the whole folder in place at once.
"""

from __future__ import annotations

import fcntl
import hashlib
import io
import itertools
import json
import os
import re
import shutil
import sqlite3
import stat
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePosixPath
from typing import BinaryIO

from pydantic import ValidationError

from hal.atomic_write import flush_folder
from hal.errors import ConfigError
from hal.strict import Strict
from service.errors import FileFault, JournalError
from service.tasks.journal_reader import read_records, verify_chain

FORMAT = 1
MANIFEST = "manifest.json"
JOURNAL = ".service/journal.sqlite"
LOCK = ".service/lock"
MODE = 0o600  # a backup has the journal's secret and the hashes of the keys
CHUNK = 1 << 20
PASSING = re.compile(r".*(\.lock|/lock|-wal|-shm|-journal|\.new|\.part)")  # of a running program, or not complete
MOST_FAULTS = 50


class Entry(Strict):
    """One file of a backup; `path` is relative to the service's folder."""

    path: str
    size_bytes: int
    sha256: str
    mode: int


class Manifest(Strict):
    """What a backup has; it stands at the end of the file."""

    format: int
    version: str
    files: tuple[Entry, ...]

    def sha256(self) -> str:
        """Return one hash of all paths and contents, which two equal folders share."""
        lines = sorted(f"{entry.sha256}  {entry.path}\n" for entry in self.files)
        return hashlib.sha256("".join(lines).encode()).hexdigest()


@dataclass(frozen=True, slots=True, kw_only=True)
class _Hashed:
    """A file that is hashed while it is read."""

    file: BinaryIO
    digest: hashlib._Hash

    def read(self, size: int) -> bytes:
        data = self.file.read(size)
        self.digest.update(data)
        return data


def own_version() -> str:
    """Return the installed version; 0 if the package is not installed."""
    try:
        return version("panelwright")
    except PackageNotFoundError:
        return "0"


def backup(runs: Path, file: Path) -> Manifest:
    """Write everything below `runs` to `file`, also while a service runs; the file exists complete or not at all.

    Raises:
        ConfigError: there is no such folder, or the file is inside it.
        FileFault: a file changed or could not be read.
    """
    if not runs.is_dir():
        raise ConfigError(f"there is no folder {runs}", hint="name the service's folder: --runs")
    if file.resolve().is_relative_to(runs.resolve()):
        raise ConfigError(f"the backup {file} would be inside {runs}", hint="write it to another place")
    partial = file.with_name(file.name + ".part")
    try:
        number = os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, MODE)
        with os.fdopen(number, "wb") as out:
            os.fchmod(number, MODE)
            with tarfile.open(fileobj=out, mode="w:gz", compresslevel=3) as tar:
                manifest = _write_all(runs, tar)
            out.flush()
            os.fsync(number)
        partial.replace(file)
        flush_folder(file.absolute().parent)
    except (OSError, sqlite3.Error, tarfile.TarError) as error:
        raise FileFault(
            f"the backup was not written: {error}", hint="is there room, and may this user read it all?"
        ) from error
    finally:
        partial.unlink(missing_ok=True)
    return manifest


def _write_all(runs: Path, tar: tarfile.TarFile) -> Manifest:
    entries: list[Entry] = []
    with tempfile.TemporaryDirectory(prefix="panelwright-backup-") as folder:
        # The databases first: rows that the journal moves to an older part meanwhile are then found in that part.
        databases = [path for path in _files_of(runs) if path.suffix == ".sqlite"]
        databases.sort(key=lambda path: "-" in path.stem)
        for path in databases:
            copy = Path(folder) / "copy.sqlite"
            _copy_database(path, copy)
            entries.append(_add(tar, copy, path.relative_to(runs), stat.S_IMODE(path.stat().st_mode)))
            copy.unlink()
        done = set(databases)
        for path in _files_of(runs):
            with suppress(FileNotFoundError):  # deleted meanwhile
                if path not in done:
                    entries.append(_add(tar, path, path.relative_to(runs), stat.S_IMODE(path.stat().st_mode)))
    manifest = Manifest(format=FORMAT, version=own_version(), files=tuple(entries))
    data = manifest.model_dump_json(indent=1).encode()
    info = tarfile.TarInfo(MANIFEST)
    info.size, info.mode = len(data), MODE
    tar.addfile(info, io.BytesIO(data))
    return manifest


def _files_of(runs: Path) -> Iterator[Path]:
    """Yield the regular files of a folder in the order of their names, without those of a running program."""
    for path in sorted(runs.rglob("*")):
        if not path.is_symlink() and path.is_file() and not PASSING.fullmatch(path.as_posix()):
            yield path


def _copy_database(path: Path, copy: Path) -> None:
    uri = path.absolute().as_uri()
    with closing(sqlite3.connect(f"{uri}?mode=ro", uri=True)) as source, closing(sqlite3.connect(copy)) as target:
        source.backup(target)


def _add(tar: tarfile.TarFile, path: Path, name: Path, mode: int) -> Entry:
    with path.open("rb") as file:
        info = tarfile.TarInfo(f"runs/{name.as_posix()}")
        info.size, info.mode = os.fstat(file.fileno()).st_size, mode
        hashed = _Hashed(file=file, digest=hashlib.sha256())
        tar.addfile(info, hashed)  # type: ignore[arg-type]  # it needs no more than `read`
    return Entry(path=name.as_posix(), size_bytes=info.size, sha256=hashed.digest.hexdigest(), mode=mode)


def restore(file: Path, runs: Path) -> tuple[Manifest, Path | None]:
    """Put a backup in the place of `runs`; returns what it has, and where the folder that was there is now.

    Raises:
        ConfigError: names everything that speaks against it; nothing was changed.
        FileFault: the folder could not be written.
    """
    fresh = runs.with_name(f"{runs.name}.restoring")
    shutil.rmtree(fresh, ignore_errors=True)
    with _alone_in(runs) as running:
        try:
            manifest, damaged = _extract(file, fresh)
            faults = [*running, *damaged, *_faults_of_versions(manifest, fresh, runs)]
            if faults or manifest is None:
                raise ConfigError(
                    f"nothing was restored: {faults[0]}", hint="nothing was changed", faults=faults[:MOST_FAULTS]
                )
            return manifest, _put_in_place(fresh, runs)
        except OSError as error:
            raise FileFault(
                f"{runs} was not restored: {error}", hint="is there room, and may this user write it?"
            ) from error
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def _extract(file: Path, fresh: Path) -> tuple[Manifest | None, list[str]]:
    """Write the files of a backup to `fresh`; returns its manifest and everything that is wrong with it."""
    found: dict[str, str] = {}
    faults: list[str] = []
    manifest: Manifest | None = None
    try:
        with tarfile.open(file, mode="r:gz") as tar:
            for info in tar:
                data = tar.extractfile(info) if info.isreg() else None
                if data is None or not (info.name == MANIFEST or _is_plain(info.name)):
                    faults.append(f"{info.name[:100]!r} is no file of a backup")
                elif info.name == MANIFEST:
                    manifest = Manifest.model_validate(json.loads(data.read()), strict=False)
                else:
                    name = info.name.removeprefix("runs/")
                    found[name] = _write(data, fresh / name, info.mode)
    except (tarfile.TarError, EOFError, OSError, ValueError, ValidationError) as error:
        faults.append(f"{file} is no complete backup: {type(error).__name__}: {str(error)[:200]}")
    if manifest is None:
        return None, faults or [f"{file} has no {MANIFEST}, so it is no complete backup"]
    said = {entry.path: entry.sha256 for entry in manifest.files}
    faults += [f"{name} is missing in the backup" for name in said.keys() - found.keys()]
    faults += [f"{name} is not in the backup's list" for name in found.keys() - said.keys()]
    faults += [
        f"{name} has another hash than when it was saved"
        for name in found
        if found[name] != said.get(name, found[name])
    ]
    return manifest, faults


def _is_plain(name: str) -> bool:
    parts = PurePosixPath(name).parts
    return len(parts) > 1 and parts[0] == "runs" and ".." not in parts and "\0" not in name


def _write(data: object, path: Path, mode: int) -> str:
    path.parent.mkdir(parents=True, exist_ok=True)
    digest = hashlib.sha256()
    number = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, MODE)
    with os.fdopen(number, "wb") as out:
        while chunk := data.read(CHUNK):  # type: ignore[attr-defined]  # of the archive
            digest.update(chunk)
            out.write(chunk)
        out.flush()
        os.fsync(number)
        os.fchmod(number, mode & 0o777)
    return digest.hexdigest()


def _faults_of_versions(manifest: Manifest | None, fresh: Path, runs: Path) -> Iterator[str]:
    """Yield why this program or this folder is not fit for a backup that is complete."""
    if manifest is None:
        return
    if manifest.format > FORMAT or _numbers(manifest.version) > _numbers(own_version()):
        yield f"the backup is of panelwright {manifest.version}, and this is {own_version()}: install that version first"
    try:
        if (fresh / JOURNAL).exists():
            verify_chain(fresh / JOURNAL)
    except JournalError as error:
        yield f"the journal of the backup is not whole: {error.what}"
    try:
        saved, present = _newest(fresh), _newest(runs)
    except JournalError as error:
        yield f"the journal of {runs} cannot be compared: {error.what}; move the folder away if it is not needed"
        return
    if present[0] > saved[0] or (present[0] == saved[0] and present != saved):
        yield (
            f"{runs} has a newer journal (row {present[0]}) than the backup (row {saved[0]}), so acknowledged changes would be "
            "lost: move the folder away if this is meant"
        )


def _newest(runs: Path) -> tuple[int, str]:
    path = runs / JOURNAL
    newest = read_records(path, limit=1) if path.exists() else []
    return (newest[0].id, newest[0].hash) if newest else (0, "")


@contextmanager
def _alone_in(runs: Path) -> Iterator[list[str]]:
    """Keep services out of a folder; yields a fault if one is in it."""
    lock = runs / LOCK
    if not lock.parent.is_dir():
        yield []
        return
    with lock.open("a") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            yield [f"a service runs in {runs}: end it first"]
            return
        yield []


def _put_in_place(fresh: Path, runs: Path) -> Path | None:
    """Rename both folders; returns where the present one is now."""
    names = (runs.with_name(f"{runs.name}.before-restore-{number}") for number in itertools.count(1))
    aside = next(name for name in names if not name.exists()) if runs.exists() else None
    if aside is not None:
        runs.rename(aside)
    fresh.rename(runs)
    flush_folder(runs.absolute().parent)
    return aside


def _numbers(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text)[:4])
