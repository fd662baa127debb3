"""Writes plain values as TOML text by tomlkit, which escapes strings and preserves the comments of an edited text."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping, Sequence
from typing import Any

import tomlkit
from tomlkit.items import AoT, Table


def toml_text(data: Mapping[str, Any], *, remarks: Sequence[str] = ()) -> str:
    """Return a TOML document: scalars first, then one table per mapping and one per entry of a list of mappings.

    Args:
        data: strings, booleans, finite numbers, lists and mappings; mappings inside a table are written inline.
        remarks: comments for the beginning of the document, one line each.
    """
    document = tomlkit.document()
    for remark in remarks:
        document.add(tomlkit.comment(remark))
    _put_all(document, data)
    return tomlkit.dumps(document)


def toml_edited(text: str, data: Mapping[str, Any]) -> str:
    """Return `text` edited to contain exactly `data`; unchanged entries keep their position, notation and comments.

    Args:
        text: a TOML document.
        data: as for `toml_text`.

    Raises:
        ValueError: the text is not TOML.
    """
    document = tomlkit.parse(text)
    _edit(document, data)
    return tomlkit.dumps(document)


def _put_all(table: MutableMapping[str, Any], data: Mapping[str, Any]) -> None:
    """Add every entry, those that become separate tables last, because entries after a table's header belong to it."""
    for key, value in data.items():
        if not _is_table(value) and not _is_tables(value):
            table[key] = _item(value)
    for key, value in data.items():
        if _is_table(value):
            table[key] = _table(value)
        elif _is_tables(value):
            tables = tomlkit.aot()
            for row in value:
                tables.append(_table(row))
            table[key] = tables


def _edit(table: MutableMapping[str, Any], data: Mapping[str, Any]) -> None:
    for key in [key for key in table if key not in data]:
        del table[key]
    for key, value in data.items():
        old = table.get(key)
        if isinstance(old, Table) and _is_table(value):
            _edit(old, value)
        elif isinstance(old, AoT) and _is_tables(value):
            _edit_rows(old, value)
        elif key not in table:
            _put_all(table, {key: value})
        elif not _is_same(old, value):
            table[key] = _item(value)


def _edit_rows(rows: AoT, data: Sequence[Mapping[str, Any]]) -> None:
    while len(rows) > len(data):
        del rows[len(rows) - 1]
    for row, value in zip(list(rows), data, strict=False):
        _edit(row, value)
    for value in data[len(rows) :]:
        rows.append(_table(value))


def _table(data: Mapping[str, Any]) -> Table:
    table = tomlkit.table()
    for key, value in data.items():
        table[key] = _item(value)
    return table


def _item(value: Any) -> Any:
    """Return the value as an item of tomlkit; mappings become inline tables."""
    if isinstance(value, Mapping):
        inline = tomlkit.inline_table()
        for key, part in value.items():
            inline[key] = _item(part)
        return inline
    if isinstance(value, list | tuple):
        return tomlkit.item([_item(part) for part in value])
    return tomlkit.item(value)


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_tables(value: Any) -> bool:
    return isinstance(value, list | tuple) and bool(value) and all(isinstance(row, Mapping) for row in value)


def _is_same(old: Any, value: Any) -> bool:
    """Return whether an item already has the value; 1 and 1.0 differ, as they do for a strict reader."""
    plain = old.unwrap() if hasattr(old, "unwrap") else old
    wanted = list(value) if isinstance(value, tuple) else value
    return type(plain) is type(wanted) and bool(plain == wanted)
