"""Looks at all cells of a site at once; one that does not answer holds up no other, and says why it is not shown."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.errors import CellError
from service.access.keys import key_from_file
from service.client import ApiError, Client
from service.site.site_file import CellEntry, SiteFile

MOST_THREADS = 32


@dataclass(frozen=True, slots=True, kw_only=True)
class CellLook:
    """What a cell says about itself.

    Attributes:
        why: why it could not be asked; empty for a cell that has answered, to which all else belongs.
        state: `ready`, `stopped`, or why it is not ready.
        alarms: those that are not normal, those that need a person first, as the API shows them.
        newest: the newest reading of each object, as the API shows them.
        waiting: how many readings wait for a person.
        rounds: all rounds with what comes next, as the API shows them.
    """

    name: str
    url: str
    why: str = ""
    cell: str = ""
    panel: str = ""
    mode: str = ""
    state: str = ""
    alarms: Sequence[dict[str, Any]] = ()
    newest: Sequence[dict[str, Any]] = ()
    waiting: int = 0
    rounds: Sequence[dict[str, Any]] = ()
    console_url: str | None = None

    @property
    def answers(self) -> bool:
        """Whether the cell has answered."""
        return not self.why

    @property
    def unseen(self) -> list[dict[str, Any]]:
        """The alarms that nobody has acknowledged."""
        return [alarm for alarm in self.alarms if "unacknowledged" in alarm["state"]]

    @property
    def newest_s(self) -> float | None:
        """Time of the newest reading, seconds since 1970; None without any."""
        return max((one["utc_s"] for one in self.newest), default=None)

    @property
    def next_round(self) -> dict[str, Any] | None:
        """The round that is due next; None without rounds."""
        return min(self.rounds, key=lambda one: float(one["next_s"]), default=None)


@dataclass(frozen=True, slots=True, kw_only=True)
class Cells:
    """The clients of a site's cells; `folder` is that of the site file."""

    site: SiteFile
    folder: Path = field(default_factory=Path)

    def client(self, entry: CellEntry) -> Client:
        """Return the client of a cell.

        Raises:
            ConfigError, KeysUnusable: its key file cannot be used.
        """
        key = None if entry.key_file is None else key_from_file(self.folder / entry.key_file)
        ca = None if entry.ca is None else self.folder / entry.ca
        return Client(url=entry.url.rstrip("/"), timeout_s=self.site.timeout_s, key=key, ca=ca)

    def look(self) -> list[CellLook]:
        """Ask all cells at once; returns them in the order of the site file."""
        with ThreadPoolExecutor(min(MOST_THREADS, len(self.site.cells))) as pool:
            return list(pool.map(self._look_at, self.site.cells))

    def _look_at(self, entry: CellEntry) -> CellLook:
        try:
            return _asked(entry, self.client(entry))
        except CellError as error:
            return CellLook(name=entry.name, url=entry.url, why=error.what)
        except (LookupError, TypeError, AttributeError) as error:  # another program or version answers there
            return CellLook(name=entry.name, url=entry.url, why=f"its answers are not understood: {error!r}")


def _asked(entry: CellEntry, client: Client) -> CellLook:
    info, stop = client.get("/v1/info"), client.get("/v1/stop")
    review = client.get("/v1/review?limit=1")
    return CellLook(
        name=entry.name,
        url=entry.url,
        cell=str(info["cell"]),
        panel=str(info["panel"]),
        mode=str(info["mode"]),
        state=f"stopped ({stop['source']})" if stop["is_latched"] else _readiness(client),
        alarms=tuple(client.get("/v1/alarms")["alarms"]),
        newest=tuple(client.get("/v1/history")["newest"]),
        waiting=int(review["waiting"]),
        rounds=tuple(client.get("/v1/rounds")["rounds"]),
        console_url=info["console_url"],
    )


def _readiness(client: Client) -> str:
    try:
        found = client.get("/readyz")
    except ApiError:
        return "not running"
    if found["journal_problem"] is not None:
        return f"no journal: {found['journal_problem']}"
    missing = [str(one["device"]) for one in found["missing"]]
    return f"without {', '.join(missing)}" if missing else "ready"
