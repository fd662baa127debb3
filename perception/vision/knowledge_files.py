"""Files of kinds: TOML if a person taught or wrote it, a numpy archive (`.npz`) if a benchmark generated it.

Both contain name, size, and looks in hundredths. An archive loads some hundred times faster, and nobody reads thousands
of generated rows. A folder contains each kind once.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from hal.arrays import Array
from hal.atomic_write import write_atomically
from hal.errors import ConfigError
from hal.panel.kinds import home_of, installed_kinds
from hal.strict import Strict, load_toml
from hal.toml_text import toml_text
from perception.vision.knowledge import Knowledge, TaughtKind, spread_of
from perception.vision.look import AROUND_GROUPS, DIRECTIONS, GROUPS, LEAST_REACH_M, LENGTH, RADII_M, RINGS

FOLDER = "knowledge"
SHIPPED = Path(__file__).parent / FOLDER
OTHER_FILES = frozenset({"proportions"})  # of a knowledge folder, which are not kinds
UNIT = 100.0  # looks are stored in hundredths
REPAIR = "restore it, or delete it and teach the kind again"

Row = Annotated[tuple[int, ...], Field(min_length=len(RADII_M), max_length=len(RADII_M))]

RingRow = Annotated[tuple[int, ...], Field(min_length=RINGS, max_length=RINGS)]
Around = Annotated[tuple[RingRow, ...], Field(min_length=DIRECTIONS, max_length=DIRECTIONS)]


class LookRecord(Strict):
    """One example: relative gray, unevenness, edges and strong edges over the distance from the middle, in hundredths.

    `middle_m`: offset from the place with this look to the object's middle, x right and y up. It is not zero if a part
    of the object or its label is more distinct than its middle.

    `gray_around` and `edge_around` have one row per direction, clockwise from straight up; if they are absent, all
    directions have the values of `gray` and `edge`. `noisy`: the look counts in noisy images only. `reach_m`: numbers of
    larger circles do not count, because neighbours are there; absent if all count.
    """

    gray: Row
    uneven: Row
    edge: Row
    strong_edge: Row
    gray_around: Around | None = None
    edge_around: Around | None = None
    middle_m: tuple[float, float] = (0.0, 0.0)
    noisy: bool = False
    reach_m: Annotated[float, Field(ge=LEAST_REACH_M, le=1.0)] | None = None

    @property
    def look(self) -> Array:
        """The numbers (LENGTH,) in the order of the module `look`."""
        around = [
            np.asarray(given, float).ravel() if given is not None else np.tile(_ring_means(row), DIRECTIONS)
            for given, row in ((self.gray_around, self.gray), (self.edge_around, self.edge))
        ]
        rows = np.array([*self.gray, *self.uneven, *self.edge, *self.strong_edge], float)
        return np.concatenate([rows, *around]) / UNIT


class KindRecord(Strict):
    """Content of a kind's file."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
    width_m: Annotated[float, Field(gt=0, le=1.0)]
    height_m: Annotated[float, Field(gt=0, le=1.0)]
    taught_by: str = ""
    looks: tuple[LookRecord, ...] = ()

    @model_validator(mode="after")
    def _has_looks(self) -> KindRecord:
        if not self.looks:
            raise ValueError("a kind needs at least one look")
        return self


def load_knowledge(folder: Path | None = None) -> Knowledge:
    """Load all kinds of a folder, by name; those that come with the package if none is given.

    Raises:
        ConfigError: a file is malformed, a kind has two files, or the folder contains no kind.
    """
    files = kind_files(folder)
    if not files:
        raise ConfigError(f"no kinds in {folder}", hint="teach one: panelwright teach IMAGE", file=str(folder))
    kinds = tuple(load_kind(path) for path in files)
    return Knowledge(kinds=kinds, spread=spread_of(kinds))


def kind_files(folder: Path | None = None) -> list[Path]:
    """Return the files of a folder's kinds, by name; if none is given, those that come with the installed packages.

    A package that adds a kind keeps the file in the folder `knowledge` beside its model.

    Raises:
        ConfigError: a kind has two files.
    """
    found: dict[str, Path] = {}
    folders = (
        [folder] if folder is not None else [SHIPPED, *sorted({home_of(kind) / FOLDER for kind in installed_kinds()})]
    )
    for path in [path for each in folders for suffix in ("npz", "toml") for path in sorted(each.glob(f"*.{suffix}"))]:
        if path.stem in OTHER_FILES:
            continue
        if path.stem in found:
            what = f"kind {path.stem!r} has two files, {found[path.stem]} and {path}"
            raise ConfigError(what, hint="keep one of them", file=str(path))
        found[path.stem] = path
    return [found[name] for name in sorted(found)]


def load_kind(path: Path) -> TaughtKind:
    """Load the kind of one file.

    Raises:
        ConfigError: the file is malformed or damaged; the message names it and the hint says what helps.
    """
    return _archived(path) if path.suffix == ".npz" else _kind(load_toml(path, KindRecord, "knowledge file"))


def write_kind(kind: TaughtKind, folder: Path) -> Path:
    """Write one kind as TOML and return the path.

    If only looks are new, they are appended to the existing file.
    """
    path = folder / f"{kind.name}.toml"
    known = load_kind(path) if path.exists() else None
    if known is not None and _is_continued(known, kind):
        more = _looks_text(kind.of(np.arange(len(known.looks), len(kind.looks))))
        return write_atomically(path, path.read_text(encoding="utf-8").rstrip("\n") + "\n" + more)
    return write_atomically(path, kind_text(kind))


def kind_text(kind: TaughtKind) -> str:
    """Return the TOML text of one kind."""
    remark = (
        f"What a {kind.name.replace('_', ' ')} looks like: rows over the distance from its middle, "
        f"{RADII_M[0] * 1e3:g} to {RADII_M[-1] * 1e3:g} mm, in hundredths."
    )
    head = {"name": kind.name, "width_m": round(float(kind.size_m[0]), 4), "height_m": round(float(kind.size_m[1]), 4)}
    taught_by = {"taught_by": kind.taught_by} if kind.taught_by else {}
    return toml_text({**head, **taught_by}, remarks=[remark]) + _looks_text(kind)


def write_generated_kind(kind: TaughtKind, folder: Path) -> Path:
    """Write one kind as a numpy archive and return its path; an archive has no reach, generated looks count everywhere."""
    path = folder / f"{kind.name}.npz"
    count = len(kind.looks)
    np.savez_compressed(
        path,
        name=np.array(kind.name),
        taught_by=np.array(kind.taught_by),
        size_m=np.round(np.asarray(kind.size_m, float), 4),
        looks=np.round(UNIT * kind.looks).astype(np.int16),
        middles_m=np.zeros((count, 2)) if kind.middles_m is None else np.round(kind.middles_m, 4),
        noisy=np.zeros(count, bool) if kind.noisy is None else kind.noisy,
    )
    return path


def _archived(path: Path) -> TaughtKind:
    """Load the kind of a numpy archive.

    Raises:
        ConfigError: the file is malformed or damaged.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            name, taught_by, size_m = str(file["name"]), str(file["taught_by"]), file["size_m"]
            looks, middles_m, noisy = file["looks"], file["middles_m"], file["noisy"]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"knowledge file {path} cannot be read: {error}", hint=REPAIR, file=str(path)) from error
    count = len(looks) if looks.ndim else 0
    shapes = {"size_m": (2,), "looks": (count, LENGTH), "middles_m": (count, 2), "noisy": (count,)}
    given = {"size_m": size_m, "looks": looks, "middles_m": middles_m, "noisy": noisy}
    wrong = next((key for key, shape in shapes.items() if given[key].shape != shape), None)
    if wrong is not None or count == 0 or looks.dtype.kind != "i" or noisy.dtype.kind != "b" or name != path.stem:
        raise ConfigError(
            f"knowledge file {path} holds no kind of this name: {wrong or 'its looks'} cannot be", hint=REPAIR,
            file=str(path),
        )  # fmt: skip
    return TaughtKind(
        name=name,
        size_m=(float(size_m[0]), float(size_m[1])),
        looks=np.asarray(looks, float) / UNIT,
        taught_by=taught_by,
        middles_m=middles_m if middles_m.any() else None,
        noisy=noisy if noisy.any() else None,
    )


def _is_continued(known: TaughtKind, kind: TaughtKind) -> bool:
    """Return whether a kind is the known one with further looks."""
    first = kind.of(np.arange(min(len(known.looks), len(kind.looks))))
    return (known.name, known.taught_by) == (kind.name, kind.taught_by) and _looks_text(first) == _looks_text(known)


def _looks_text(kind: TaughtKind) -> str:
    """Return the TOML text of the looks, one table per look; it has only whole numbers, which need no escaping."""
    lines = []
    for k, look in enumerate(kind.looks):
        lines.append("\n[[looks]]")
        if kind.middles_m is not None and kind.middles_m[k].any():
            lines.append("middle_m = [{:.4f}, {:.4f}]".format(*kind.middles_m[k]))
        if kind.noisy is not None and kind.noisy[k]:
            lines.append("noisy = true")
        if kind.reach_m is not None and np.isfinite(kind.reach_m[k]):
            lines.append(f"reach_m = {kind.reach_m[k]:.4f}")
        rows = look[: len(GROUPS) * len(RADII_M)].reshape(len(GROUPS), -1)
        lines += [f"{name} = {_written(row)}" for name, row in zip(GROUPS, rows, strict=True)]
        tables = look[len(GROUPS) * len(RADII_M) :].reshape(len(AROUND_GROUPS), DIRECTIONS, RINGS)
        for name, table in zip(AROUND_GROUPS, tables, strict=True):
            lines.append(f"{name} = [{', '.join(_written(row) for row in table)}]")
    return "".join(f"{line}\n" for line in lines)


def _kind(record: KindRecord) -> TaughtKind:
    """Build the kind of a TOML record."""
    middles_m = np.array([look.middle_m for look in record.looks])
    noisy = np.array([look.noisy for look in record.looks])
    reach_m = np.array([np.inf if look.reach_m is None else look.reach_m for look in record.looks])
    return TaughtKind(
        name=record.name,
        size_m=(record.width_m, record.height_m),
        looks=np.array([look.look for look in record.looks]).reshape(-1, LENGTH),
        taught_by=record.taught_by,
        middles_m=middles_m if middles_m.any() else None,
        noisy=noisy if noisy.any() else None,
        reach_m=reach_m if np.isfinite(reach_m).any() else None,
    )


def _ring_means(row: tuple[int, ...]) -> Array:
    """Return the means (RINGS,) of a row over all radii, two radii per ring."""
    return np.asarray(np.array(row[: 2 * RINGS], float).reshape(RINGS, 2).mean(axis=1))


def _written(row: Array) -> str:
    """Return a row in hundredths as a TOML array."""
    return f"[{', '.join(str(round(float(v) * UNIT)) for v in row)}]"
