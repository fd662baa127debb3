"""What the system knows of kinds of objects: readable TOML, one file a kind, written by teaching or by hand.

A kind has a size and looks. A look is what one taught example looked like (see `features`): four rows of numbers over the
distance from the middle, in hundredths, and two tables with such a row a direction. The file `nothing.toml` holds looks
of what is *not* an object: screws, labels, parts of objects. Adding a look to one kind changes no other kind's looks.

Some looks are of noisy images, as a camera takes them in bad light, and only noisy images are compared with these: there a
blurred, half shaded thing is worth knowing, and in a good image it would be taken for others.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from hal.arrays import Array
from hal.atomic_write import write_atomically
from hal.errors import ConfigError
from hal.strict import Strict, load_toml
from perception.vision.finding.features import (
    AROUND_GROUPS,
    DIRECTIONS,
    GROUPS,
    LENGTH,
    NOISY_WEIGHTS,
    RADII_M,
    RINGS,
    WEIGHTS,
)

NOTHING = "nothing"
UNIT = 100.0  # looks are stored in hundredths

Row = Annotated[tuple[int, ...], Field(min_length=len(RADII_M), max_length=len(RADII_M))]

RingRow = Annotated[tuple[int, ...], Field(min_length=RINGS, max_length=RINGS)]
Around = Annotated[tuple[RingRow, ...], Field(min_length=DIRECTIONS, max_length=DIRECTIONS)]


class LookRecord(Strict):
    """One example: relative gray, unevenness, edges and strong edges over the distance from the middle, hundredths.

    `middle_m`: from the place that looks so to the object's middle, x right and y up, where a part of the object or its
    label shows better than its middle.

    `gray_around` and `edge_around` have a row a direction, clockwise from straight up; left out, every direction is as
    `gray` and `edge` are all around. `noisy`: counts in noisy images only.
    """

    gray: Row
    uneven: Row
    edge: Row
    strong_edge: Row
    gray_around: Around | None = None
    edge_around: Around | None = None
    middle_m: tuple[float, float] = (0.0, 0.0)
    noisy: bool = False

    @property
    def look(self) -> Array:
        """(LENGTH,) in the order of `features`."""
        around = [
            np.asarray(given, float).ravel() if given is not None else np.tile(_ring_means(row), DIRECTIONS)
            for given, row in ((self.gray_around, self.gray), (self.edge_around, self.edge))
        ]
        rows = np.array([*self.gray, *self.uneven, *self.edge, *self.strong_edge], float)
        return np.concatenate([rows, *around]) / UNIT


class KindRecord(Strict):
    """A kind's file."""

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtKind:
    """A kind of object.

    Attributes:
        name: as in the panel file where readers exist, else free.
        size_m: (width, height) of a typical one, m.
        looks: (N, LENGTH), one row an example.
        middles_m: (N, 2) from the place that looks so to the object's middle, x right, y up; None: that is the middle.
        noisy: (N,) which looks count in noisy images only; None: none of them.
    """

    name: str
    size_m: tuple[float, float]
    looks: Array
    taught_by: str = ""
    middles_m: Array | None = None
    noisy: NDArray[np.bool_] | None = None

    @property
    def lasting(self) -> TaughtKind:
        """The kind with the looks only that count in every image."""
        return self if self.noisy is None else replace(self.of(~self.noisy), noisy=None)

    def of(self, rows: NDArray[Any]) -> TaughtKind:
        """The kind with some of its looks only."""
        middles_m = None if self.middles_m is None else self.middles_m[rows]
        noisy = None if self.noisy is None else self.noisy[rows]
        return replace(self, looks=self.looks[rows], middles_m=middles_m, noisy=noisy)

    def joined(self, other: TaughtKind) -> TaughtKind:
        """The kind with another one's looks after its own."""
        middles_m = None
        if self.middles_m is not None or other.middles_m is not None:
            middles_m = np.vstack(
                [np.zeros((len(k.looks), 2)) if k.middles_m is None else k.middles_m for k in (self, other)]
            )
        noisy = None
        if self.noisy is not None or other.noisy is not None:
            noisy = np.concatenate(
                [np.zeros(len(k.looks), bool) if k.noisy is None else k.noisy for k in (self, other)]
            )
        return replace(self, looks=np.vstack([self.looks, other.looks]), middles_m=middles_m, noisy=noisy)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Knowledge:
    """All kinds, and what likeness to them means.

    Attributes:
        spread: (LENGTH,) how much every number varies between things at all, the unit of likeness.
        weights: (LENGTH,) of the numbers.
    """

    kinds: tuple[TaughtKind, ...]
    spread: Array
    weights: Array = field(default_factory=lambda: WEIGHTS)

    def for_image(self, *, noisy: bool) -> Knowledge:
        """What an image is compared with: if it is noisy, all looks without what lies far from their middles; else only
        the looks that count in every image.
        """
        return _for_image(self, noisy=noisy)

    def kind(self, name: str) -> TaughtKind | None:
        """The kind of that name, or None."""
        return next((kind for kind in self.kinds if kind.name == name), None)

    def with_look(self, name: str, size_m: tuple[float, float], look: Array, *, taught_by: str = "") -> Knowledge:
        """The knowledge with one more look; a new name makes a new kind."""
        return self.grown(TaughtKind(name=name, size_m=size_m, looks=look[None], taught_by=taught_by))

    def grown(self, more: TaughtKind) -> Knowledge:
        """The knowledge with further looks of a kind, which may be new."""
        known = self.kind(more.name)
        if known is None:
            return replace(self, kinds=(*self.kinds, more))
        return replace(self, kinds=tuple(kind.joined(more) if kind is known else kind for kind in self.kinds))

    def with_looks_of(self, kinds: Iterable[TaughtKind]) -> Knowledge:
        """The knowledge with these kinds' looks beside its own; a new name makes a new kind, a known look adds nothing."""
        grown = self
        for kind in kinds:
            known = grown.kind(kind.name)
            seen = set() if known is None else {look.tobytes() for look in known.looks}
            grown = grown.grown(kind.of(np.array([look.tobytes() not in seen for look in kind.looks])))
        return grown


def shipped_knowledge() -> Knowledge:
    """The kinds that come with the system."""
    return load_knowledge(Path(__file__).parent / "knowledge")


def load_knowledge(folder: Path) -> Knowledge:
    """All kinds of a folder: `*.toml` with looks.

    Raises:
        ConfigError: a file is malformed, or the folder holds no kind.
    """
    records = [
        load_toml(path, KindRecord, "knowledge file") for path in sorted(folder.glob("*.toml")) if not _is_other(path)
    ]
    if not records:
        raise ConfigError(f"no kinds in {folder}", hint="teach one: panelwright teach IMAGE", file=str(folder))
    kinds = tuple(_kind(record) for record in records)
    return Knowledge(kinds=kinds, spread=spread_of(kinds))


@lru_cache(maxsize=8)
def _for_image(knowledge: Knowledge, *, noisy: bool) -> Knowledge:
    """See `Knowledge.for_image`: the same object every time, as `prepared` wants it."""
    if noisy:
        return replace(knowledge, weights=NOISY_WEIGHTS)
    kinds = (kind.lasting for kind in knowledge.kinds)
    return replace(knowledge, kinds=tuple(kind for kind in kinds if len(kind.looks)), weights=WEIGHTS)


def spread_of(kinds: Iterable[TaughtKind]) -> Array:
    """(LENGTH,) standard deviation of every number over the kinds' looks that count in every image, each kind counting
    the same.
    """
    lasting = (kind.lasting for kind in kinds if kind.name != NOTHING)
    kinds = [kind for kind in lasting if len(kind.looks)]
    means = np.array([kind.looks.mean(axis=0) for kind in kinds])
    within = np.array([kind.looks.var(axis=0) for kind in kinds]).mean(axis=0)
    return np.asarray(np.maximum(np.sqrt(within + means.var(axis=0)), 0.05))


def write_kind(kind: TaughtKind, folder: Path) -> Path:
    """Write one kind's file and return its path."""
    lines = [
        f"# What a {kind.name.replace('_', ' ')} looks like: rows over the distance from its middle, "
        f"{RADII_M[0] * 1e3:g} to {RADII_M[-1] * 1e3:g} mm, in hundredths.",
        f'name = "{kind.name}"',
        f"width_m = {kind.size_m[0]:.4f}",
        f"height_m = {kind.size_m[1]:.4f}",
    ]
    if kind.taught_by:
        lines.append(f'taught_by = "{kind.taught_by}"')
    for k, look in enumerate(kind.looks):
        lines.append("\n[[looks]]")
        if kind.middles_m is not None and kind.middles_m[k].any():
            lines.append("middle_m = [{:.4f}, {:.4f}]".format(*kind.middles_m[k]))
        if kind.noisy is not None and kind.noisy[k]:
            lines.append("noisy = true")
        rows = look[: len(GROUPS) * len(RADII_M)].reshape(len(GROUPS), -1)
        lines += [f"{name} = {_written(row)}" for name, row in zip(GROUPS, rows, strict=True)]
        tables = look[len(GROUPS) * len(RADII_M) :].reshape(len(AROUND_GROUPS), DIRECTIONS, RINGS)
        for name, table in zip(AROUND_GROUPS, tables, strict=True):
            lines.append(f"{name} = [{', '.join(_written(row) for row in table)}]")
    return write_atomically(folder / f"{kind.name}.toml", "\n".join(lines) + "\n")


def _is_other(path: Path) -> bool:
    return path.stem == "proportions"


def _kind(record: KindRecord) -> TaughtKind:
    middles_m = np.array([look.middle_m for look in record.looks])
    noisy = np.array([look.noisy for look in record.looks])
    return TaughtKind(
        name=record.name,
        size_m=(record.width_m, record.height_m),
        looks=np.array([look.look for look in record.looks]).reshape(-1, LENGTH),
        taught_by=record.taught_by,
        middles_m=middles_m if middles_m.any() else None,
        noisy=noisy if noisy.any() else None,
    )


def _ring_means(row: tuple[int, ...]) -> Array:
    """(RINGS,) of a row over all radii."""
    return np.asarray(np.array(row[: 2 * RINGS], float).reshape(RINGS, 2).mean(axis=1))


def _written(row: Array) -> str:
    return f"[{', '.join(str(round(float(v) * UNIT)) for v in row)}]"
