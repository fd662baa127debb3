"""Kinds are unchanged after writing and reading their files; the error for a damaged file names it and the remedy."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.errors import ConfigError
from hal.strict import parse_toml
from perception.vision.knowledge import TaughtKind
from perception.vision.knowledge_files import (
    SHIPPED,
    KindRecord,
    kind_files,
    kind_text,
    load_kind,
    load_knowledge,
    write_generated_kind,
    write_kind,
)
from perception.vision.look import LENGTH


def kind(count: int = 4, seed: int = 0) -> TaughtKind:
    rng = np.random.default_rng(seed)
    return TaughtKind(
        name="gauge",
        size_m=(0.0687, 0.05),
        looks=np.round(rng.normal(0.0, 1.0, (count, LENGTH)), 2),
        taught_by="a test",
        middles_m=np.round(rng.normal(0.0, 0.01, (count, 2)), 4),
        noisy=np.arange(count) % 2 == 1,
    )


def is_same(a: TaughtKind, b: TaughtKind) -> bool:
    told = (a.name, a.size_m, a.taught_by) == (b.name, b.size_m, b.taught_by)
    arrays = ((a.looks, b.looks), (a.middles_m, b.middles_m), (a.noisy, b.noisy))
    return told and all((x is None) is (y is None) and (x is None or np.array_equal(x, y)) for x, y in arrays)


@pytest.mark.parametrize("plain", [False, True])
def test_both_forms_give_the_same_kind_to_the_bit(tmp_path: Path, plain: bool) -> None:
    given_kind = replace(kind(), middles_m=None, noisy=None, taught_by="") if plain else kind()
    by_hand = load_kind(write_kind(given_kind, tmp_path))
    (tmp_path / "gauge.toml").unlink()
    generated = load_kind(write_generated_kind(given_kind, tmp_path))
    assert is_same(by_hand, generated)
    assert np.allclose(by_hand.looks, given_kind.looks, rtol=0, atol=1e-12)


def test_the_shipped_kinds_are_archives_and_their_text_says_the_same() -> None:
    files = kind_files()
    assert {path.suffix for path in files} == {".npz"} and {path.parent for path in files} == {SHIPPED}
    gauge = load_kind(SHIPPED / "gauge.npz")
    record = parse_toml(kind_text(gauge), KindRecord, source="gauge")
    assert np.array_equal([look.look for look in record.looks], gauge.looks)


def test_a_further_look_keeps_what_a_person_wrote_into_the_file(tmp_path: Path) -> None:
    path = write_kind(kind(3), tmp_path)
    path.write_text(path.read_text().replace("[[looks]]", "[[looks]]  # by Ada, in the morning", 1))
    more = kind(3).joined(kind(2, seed=1))
    write_kind(more, tmp_path)
    assert "# by Ada, in the morning" in path.read_text()
    assert is_same(load_kind(path), more)


def test_the_reach_of_a_taught_look_is_kept(tmp_path: Path) -> None:
    given_kind = replace(kind(), reach_m=np.array([np.inf, 0.0235, 0.008, np.inf]))
    path = write_kind(given_kind, tmp_path)
    read = load_kind(path)
    assert read.reach_m is not None and np.array_equal(read.reach_m, [np.inf, 0.0235, 0.008, np.inf])
    write_kind(read.joined(kind(1, seed=1)), tmp_path)
    assert path.read_text().count("reach_m = ") == 2


def test_other_looks_replace_the_file(tmp_path: Path) -> None:
    write_kind(kind(3), tmp_path)
    other = kind(2, seed=5)
    assert is_same(load_kind(write_kind(other, tmp_path)), other)


@given(st.text())
def test_any_teacher_survives_the_text(taught_by: str) -> None:
    record = parse_toml(kind_text(replace(kind(1), taught_by=taught_by)), KindRecord, source="gauge")
    assert record.taught_by == taught_by


def test_a_kind_with_two_files_is_refused(tmp_path: Path) -> None:
    write_kind(kind(), tmp_path)
    write_generated_kind(kind(), tmp_path)
    with pytest.raises(ConfigError, match="two files"):
        load_knowledge(tmp_path)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:300])


def _not_an_archive(path: Path) -> None:
    path.write_bytes(b"looks")


def _pickled(path: Path) -> None:
    np.savez(path, looks=np.array([{"a": 1}], dtype=object))


def _of_other_length(path: Path) -> None:
    write_generated_kind(replace(kind(), looks=kind().looks[:, :-1]), path.parent)


def _without_looks(path: Path) -> None:
    write_generated_kind(kind().of(np.arange(0)), path.parent)


def _renamed(path: Path) -> None:
    (write_generated_kind(replace(kind(), name="lamp"), path.parent)).replace(path)


@pytest.mark.parametrize("harm", [_cut, _not_an_archive, _pickled, _of_other_length, _without_looks, _renamed])
def test_a_damaged_archive_is_named_with_its_remedy(tmp_path: Path, harm: object) -> None:
    path = write_generated_kind(kind(), tmp_path)
    assert callable(harm)
    harm(path)
    with pytest.raises(ConfigError) as caught:
        load_knowledge(tmp_path)
    assert str(path) in caught.value.what and "teach the kind again" in caught.value.hint
