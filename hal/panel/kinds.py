"""Finds the model, reader, skill and simulated body of a kind of object by name, each through an entry-point group.

A package adds a kind by registering its name in these groups; the built-in kinds are registered in the same way. Only
the model is required: a kind without a skill is only read, one without a reader is not read, and one without a body
cannot be simulated.
"""

from __future__ import annotations

import inspect
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hal.entry_points import load, near_or_all, registered
from hal.errors import ConfigError, Unsupported

if TYPE_CHECKING:
    from hal.panel.base import PanelObject

KINDS = "panelwright.kinds"
READERS = "panelwright.readers"
SKILLS = "panelwright.skills"
BODIES = "panelwright.bodies"
LACKS = {
    READERS: ("a reader", "it can be located but not read"),
    SKILLS: ("a skill", "it can be read but not operated"),
    BODIES: ("a simulated body", "it is not simulated: use a panel without it, or a real cell"),
}


def installed_kinds() -> tuple[str, ...]:
    """Return the names of all kinds that a panel file may have."""
    return registered(KINDS)


@cache
def kind_model(kind: str) -> type[PanelObject]:
    """Return the model of a kind's objects.

    Raises:
        ConfigError: there is no such kind (the hint names the nearest one), its package cannot be imported, or its
            model has another name.
    """
    model: type[PanelObject] = load(KINDS, kind, "kind of object")
    if model.model_fields["kind"].default != kind:
        raise ConfigError(
            f"the kind of object registered as {kind!r} calls itself {model.model_fields['kind'].default!r}",
            hint="give the entry point and the `kind` of its model the same name",
        )
    return model


def home_of(kind: str) -> Path:
    """Return the folder of a kind's model: a package keeps there, under `knowledge`, what its kind looks like.

    Raises:
        ConfigError: no such kind, or its package does not import.
    """
    return Path(inspect.getfile(kind_model(kind))).parent


def has_part(group: str, kind: str) -> bool:
    """Return whether a kind has a reader, a skill or a body, depending on the group."""
    return kind in registered(group)


@cache
def part_of(group: str, kind: str) -> Any:
    """Return the reader, skill or body of a kind, depending on the group.

    Raises:
        Unsupported: the kind has no such part; the message states the consequence.
        ConfigError: its package cannot be imported.
    """
    what, meaning = LACKS[group]
    if not has_part(group, kind):
        raise Unsupported(
            f"a {kind} has no {what.split(maxsplit=1)[1]}: {meaning}",
            hint=f"kinds with {what}: {', '.join(registered(group)) or 'none; run `make setup`'}",
        )
    return load(group, kind, f"{what.split(maxsplit=1)[1]} of a {kind}")


def hint_for(kind: str) -> str:
    """Return a hint for the name of a kind that is not installed."""
    return near_or_all(kind, installed_kinds())
