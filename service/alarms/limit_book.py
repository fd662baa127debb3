"""Limits that people set while the service runs, in a file of their own; they take the place of those of the panel file."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from hal.atomic_write import write_atomically
from hal.errors import InvalidRequest
from hal.panel import Panel, PanelObject
from hal.panel.limits import Limits
from service.access.actor import actor
from service.errors import HistoryError

SCHEMA = 1
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class SetLimits:
    """Limits of one object; `set_s` is seconds since 1970, `by` the key that authorised them, None without keys."""

    limits: Limits
    set_s: float
    by: str | None


class LimitBook:
    """The limits that were set for objects of one panel.

    Args:
        path: JSON file, replaced in one step, so that a service that is killed leaves the old or the new limits.

    Raises:
        HistoryError: the file cannot be used. It is not changed, so that nobody watches by wrong limits without knowing it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        try:
            said = json.loads(path.read_text(encoding="utf-8"))
            if said.get("schema", SCHEMA) != SCHEMA:
                raise ValueError(f"another panelwright wrote it (schema {said['schema']}, this one knows {SCHEMA})")
            self._set = {name: _restored(one) for name, one in said["limits"].items()}
        except FileNotFoundError:
            self._set = {}
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            hint = f"restore {path} from a backup, or move it away: then the limits of the panel file hold"
            raise HistoryError(f"the limits in {path} cannot be used: {error}", hint=hint, file=str(path)) from error

    def all(self) -> dict[str, SetLimits]:
        """Return the limits that were set, by the object's name."""
        with self._lock:
            return dict(self._set)

    def put(self, name: str, limits: Limits | None) -> None:
        """Store limits of an object durably; None: those of the panel file hold again.

        Raises:
            OSError: the file cannot be written; nothing has changed.
        """
        with self._lock:
            after = {key: one for key, one in self._set.items() if key != name}
            if limits is not None:
                after[name] = SetLimits(limits=limits, set_s=time.time(), by=actor())
            told = {key: {**_plain(one.limits), "set_s": one.set_s, "by": one.by} for key, one in after.items()}
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, json.dumps({"schema": SCHEMA, "limits": told}))
            self._set = after

    def applied(self, panel: Panel) -> Panel:
        """Return the panel with these limits; those that its objects cannot have any more are left out, and logged."""
        objects = tuple(self._applied(one) for one in panel.objects)
        return panel.model_copy(update={"objects": objects})

    def _applied(self, one: PanelObject) -> PanelObject:
        found = self._set.get(one.name)
        if found is None:
            return one
        try:
            return with_limits(one, found.limits)
        except InvalidRequest as error:
            log.error("the limits that were set for %s are not used: %s", one.name, error.what)
            return one


def with_limits(one: PanelObject, limits: Limits) -> PanelObject:
    """Return an object with other limits.

    Raises:
        InvalidRequest: an object of this kind cannot have them.
    """
    if one.full_scale is None and not one.value_is_angle:
        raise InvalidRequest(f"a {one.kind} shows no value", hint="limits belong to an object that shows a value")
    try:
        return type(one).model_validate({**one.model_dump(by_alias=True), "limits": limits})
    except ValidationError as error:
        what = error.errors(include_input=False, include_url=False, include_context=False)[0]["msg"]
        raise InvalidRequest(f"{one.name} cannot have these limits: {what}", hint="give other limits") from error


def _restored(said: Mapping[str, Any]) -> SetLimits:
    plain = {key: value for key, value in said.items() if key not in ("set_s", "by")}
    return SetLimits(limits=Limits.model_validate(plain), set_s=float(said["set_s"]), by=said["by"])


def _plain(limits: Limits) -> dict[str, Any]:
    return limits.model_dump(mode="json", exclude_none=True)
