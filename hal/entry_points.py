"""Loads entry points by name at their first use; an unknown name is answered with the nearest known one."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from hal.errors import REINSTALL, ConfigError


def registered(group: str) -> tuple[str, ...]:
    """Return the names that installed packages have registered in a group, in alphabetical order."""
    return tuple(sorted(_points(group)))


def load(group: str, name: str, what: str) -> Any:
    """Return the object registered under `name`; `what` describes it in errors.

    Raises:
        ConfigError: unknown name (with the nearest known one), or its package does not import.
    """
    known = _points(group)
    if name not in known:
        raise ConfigError(f"no {what} called {name!r}", hint=near_or_all(name, known), name=name)
    try:
        return known[name].load()
    except ImportError as error:
        raise ConfigError(
            f"{what} {name!r} does not import: {error}",
            hint=f"{REINSTALL}; `panelwright doctor` says what is wrong",
            name=name,
        ) from error


def near_or_all(name: str, known: Iterable[str]) -> str:
    """Return a hint for an unknown name: the nearest known one, or all of them."""
    known = sorted(known)
    near = get_close_matches(name, known, n=1)
    return f"did you mean {near[0]!r}?" if near else f"installed: {', '.join(known) or 'none'}"


def _points(group: str) -> dict[str, EntryPoint]:
    return _points_on(group, tuple(sys.path))


@cache
def _points_on(group: str, _path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Read a group's entry points; this takes milliseconds, so they are cached until the import path changes."""
    return {point.name: point for point in entry_points(group=group)}
