"""The texts of the console, from the file of their language."""

from __future__ import annotations

import tomllib
from pathlib import Path

ENGLISH: dict[str, str] = tomllib.loads((Path(__file__).parent / "english.toml").read_text(encoding="utf-8"))


def say(key: str, **values: object) -> str:
    """Return a text with its values filled in."""
    return ENGLISH[key].format(**values)


def word(group: str, name: str) -> str:
    """Return the word for a name of the API, such as a state or a verb; a new name is shown as it is."""
    return ENGLISH.get(f"{group}.{name}", name.replace("_", " ").replace("-", " "))
