"""Plain values as TOML text: what teaching and calibration write is what `hal` reads back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence


def toml_value(value: object) -> str:
    """One value: text, truth, number, list or tuple, or mapping (as an inline table)."""
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return "[" + ", ".join(toml_value(item) for item in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + " }"
    return repr(value)


def toml_lines(table: Mapping[str, object]) -> list[str]:
    """`key = value` for every entry."""
    return [f"{key} = {toml_value(value)}" for key, value in table.items()]


def toml_document(top: Mapping[str, object], tables: Mapping[str, Sequence[Mapping[str, object]]]) -> str:
    """A document of scalars and arrays of tables."""
    lines = toml_lines(top)
    for name, rows in tables.items():
        for row in rows:
            lines += ["", f"[[{name}]]", *toml_lines(row)]
    return "\n".join(lines) + "\n"
