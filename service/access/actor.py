"""Holds the name of the key in whose name the present request acts, so that the journal can tell who did what."""

from __future__ import annotations

from contextvars import ContextVar
from typing import Any

_actor: ContextVar[str | None] = ContextVar("actor", default=None)


def act_as(name: str | None) -> None:
    """Do everything that follows in this context in the name of a key; None for nobody in particular."""
    _actor.set(name)


def actor() -> str | None:
    """Return the name of the key that acts in this context, or None."""
    return _actor.get()


def signed(data: dict[str, Any]) -> dict[str, Any]:
    """Return what is recorded with the name of the key that acts, as `key_name`; unchanged when no key acts."""
    name = _actor.get()
    return data if name is None else {**data, "key_name": name}
