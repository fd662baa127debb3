"""The file of keys: names, roles and SHA-256 hashes. A key itself is shown once, when it is added, and stored nowhere.

A key has 256 random bits, so a fast hash is enough. The file belongs to one user and has mode 0600, or it is refused.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import re
import secrets
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, ValidationError

from hal.atomic_write import write_atomically
from hal.errors import ConfigError, InvalidRequest
from hal.strict import Strict
from service.errors import KeysUnusable

FILE = "keys.json"
MODE = 0o600
KEY_BYTES = 32
RECENT_S = 0.1
OWN, GATEWAY = "this-program", "gateway"  # names that no stored key has
PREFIX = "pw_"  # so that scanners for secrets recognise a key
PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.@-]{0,63}")
Commit = Callable[[str, dict[str, Any]], None]


class Role(StrEnum):
    """What a key permits; each role permits everything that the one before permits."""

    OBSERVER = "observer"
    OPERATOR = "operator"
    MAINTAINER = "maintainer"

    def permits(self, needed: Role) -> bool:
        """Return whether this role is at least `needed`."""
        order = list(Role)
        return order.index(self) >= order.index(needed)


class Key(Strict):
    """One key as it is stored. Times are wall time, seconds since 1970."""

    name: Annotated[str, Field(pattern=rf"^{PLAIN_NAME.pattern}$")]
    role: Role
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
    added_s: float
    expires_s: float | None = None
    revoked_s: float | None = None

    def is_active(self, now_s: float) -> bool:
        """Return whether the key is neither revoked nor expired."""
        return self.revoked_s is None and (self.expires_s is None or now_s < self.expires_s)


class _File(Strict):
    version: Annotated[int, Field(ge=1, le=1)] = 1
    keys: tuple[Key, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Keys:
    """The keys at one moment, by which a whole request is judged.

    Attributes:
        stored: those of the file.
        by_hash: those of the file and of this program.
        now_s: wall time, which decides only whether a key has expired.
    """

    stored: tuple[Key, ...]
    by_hash: Mapping[str, Key]
    now_s: float

    @property
    def is_open(self) -> bool:
        """Whether there is no key at all, so that everybody on this machine may use the service."""
        return not self.stored

    def active(self) -> tuple[Key, ...]:
        """Return the stored keys that are neither revoked nor expired."""
        return tuple(key for key in self.stored if key.is_active(self.now_s))

    def find(self, secret: str) -> Key | None:
        """Return the active key with this secret, or None."""
        digest = _hash(secret)
        key = self.by_hash.get(digest)
        if key is None or not hmac.compare_digest(key.sha256, digest) or not key.is_active(self.now_s):
            return None
        return key

    def named(self, name: str) -> Key | None:
        """Return the active key with this name, or None."""
        return next((key for key in self.active() if key.name == name), None)


class KeyBook:
    """The keys of one service, read again whenever their file has changed.

    A service that has once seen keys never becomes open again while it runs: if the file is deleted, every key is refused.

    Args:
        path: the file; it need not exist.
        now: the wall clock, which decides only whether a key has expired.
    """

    def __init__(self, path: Path, *, now: Callable[[], float] = time.time) -> None:
        self.path = path
        self._now = now
        self._stamp: tuple[int, ...] | None = None
        self._keys: tuple[Key, ...] = ()
        self._had_keys = False
        self._recent: tuple[float, Keys] | None = None
        self._own_secret = _new_secret()
        self._own = Key(name=OWN, role=Role.MAINTAINER, sha256=_hash(self._own_secret), added_s=now())
        self._gateway_secret = _new_secret()
        self._gateway = Key(name=GATEWAY, role=Role.OBSERVER, sha256=_hash(self._gateway_secret), added_s=now())
        self._by_hash = self._hashes()

    def now(self) -> Keys:
        """Return the keys as they are now; the file is asked once. Errors as for `all`."""
        return Keys(stored=self.all(), by_hash=self._by_hash, now_s=self._now())

    def recent(self) -> Keys:
        """Return the keys as they were within the last 0.1 s, for streams, which ask before each message. Errors as for `all`."""
        now_s, found = time.monotonic(), self._recent  # which other threads forget when the keys change
        if found is None or now_s > found[0] + RECENT_S:
            found = self._recent = (now_s, self.now())
        return found[1]

    def all(self) -> tuple[Key, ...]:
        """Return all keys, also revoked and expired ones.

        Raises:
            KeysUnusable: others may read the file, it belongs to another user, it is damaged, or it was deleted.
        """
        try:
            status = self.path.stat()
        except FileNotFoundError:
            if self._had_keys:
                raise KeysUnusable(
                    f"the file of keys {self.path} was deleted, so every key is refused",
                    hint="add keys again with `panelwright keys add`, or restart the service",
                ) from None
            return ()
        stamp = (status.st_mtime_ns, status.st_ino, status.st_size, status.st_mode, status.st_uid)
        if stamp != self._stamp:
            self._read(status)
            self._stamp = stamp
        return self._keys

    @property
    def is_open(self) -> bool:
        """Whether there is no key at all, so that everybody on this machine may use the service."""
        return self.now().is_open

    def active(self) -> tuple[Key, ...]:
        """Return the keys that are neither revoked nor expired."""
        return self.now().active()

    def own(self) -> str:
        """Return the key for this program's own clients, which is kept in memory only and ends with the program."""
        return self._own_secret

    def for_gateway(self) -> str:
        """Return the key for this program's gateway, which may only look; it is kept in memory only."""
        return self._gateway_secret

    def find(self, secret: str) -> Key | None:
        """Return the active key with this secret, or None."""
        return self.now().find(secret)

    def named(self, name: str) -> Key | None:
        """Return the active key with this name, or None."""
        return self.now().named(name)

    def add(self, name: str, role: Role, *, valid_s: float | None, commit: Commit) -> str:
        """Add a key and return its secret, which nothing can show again.

        Args:
            valid_s: time until it expires; None for no expiry.
            commit: records the new key durably, before it is valid.

        Raises:
            InvalidRequest: the name is not plain, or an active key has it.
        """
        if not PLAIN_NAME.fullmatch(name) or name in (OWN, GATEWAY):
            raise InvalidRequest(f"{name[:40]!r} is no name of a key", hint="letters, digits and - _ . @, at most 64")
        secret = _new_secret()
        now_s = self._now()
        expires_s = None if valid_s is None else now_s + valid_s
        key = Key(name=name, role=role, sha256=_hash(secret), added_s=now_s, expires_s=expires_s)
        with self._changing():
            if self.named(name) is not None:
                raise InvalidRequest(f"there is a key called {name!r}", hint=f"`panelwright keys revoke {name}` first")
            commit("key-added", {"name": name, "role": str(role), "expires_s": expires_s})
            self._write((*(known for known in self.all() if known.name != name), key))
        return secret

    def revoke(self, name: str, *, commit: Commit) -> None:
        """Make a key invalid at once, also for a running service, whose streams ask 0.1 s later at most.

        Raises:
            InvalidRequest: no active key has this name.
        """
        with self._changing():
            if self.named(name) is None:
                known = ", ".join(key.name for key in self.active()) or "none"
                raise InvalidRequest(f"no active key is called {name[:40]!r}", hint=f"active keys: {known}")
            commit("key-revoked", {"name": name})
            now_s = self._now()
            self._write(tuple(k.model_copy(update={"revoked_s": now_s}) if k.name == name else k for k in self.all()))

    def _read(self, status: os.stat_result) -> None:
        if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            raise KeysUnusable(
                f"other users may access the file of keys {self.path} (mode {stat.S_IMODE(status.st_mode):04o})",
                hint=f"chmod 600 {self.path}, and replace the keys if anybody may have read it",
            )
        if status.st_uid not in (os.geteuid(), 0):
            raise KeysUnusable(
                f"the file of keys {self.path} belongs to user {status.st_uid}", hint="it must belong to the service's"
            )
        try:
            self._keys = _File.model_validate_json(self.path.read_bytes(), strict=False).keys
        except (OSError, ValidationError) as error:
            raise KeysUnusable(
                f"the file of keys {self.path} cannot be read: {type(error).__name__}",
                hint="restore it from a backup, or delete it and add keys again",
            ) from error
        self._by_hash, self._recent = self._hashes(), None
        self._had_keys = self._had_keys or bool(self._keys)

    def _hashes(self) -> dict[str, Key]:
        return {key.sha256: key for key in (*self._keys, self._own, self._gateway)}

    def _write(self, keys: tuple[Key, ...]) -> None:
        write_atomically(self.path, _File(keys=keys).model_dump_json(indent=1) + "\n", mode=MODE)
        self._recent = None

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Keep other processes from changing the file at the same time."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def key_from_file(path: Path) -> str:
    """Return the key that a client keeps in a file.

    Raises:
        ConfigError: the file cannot be read, is empty, or other users may access it.
    """
    try:
        mode, text = path.stat().st_mode, path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"the key file {path} cannot be read: {error}", hint="name another file") from error
    if mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"other users may access the key file {path}", hint=f"chmod 600 {path}")
    if not text:
        raise ConfigError(f"the key file {path} is empty", hint="write the key into it that `keys add` showed")
    return text


def _new_secret() -> str:
    return PREFIX + secrets.token_urlsafe(KEY_BYTES)


def _hash(secret: str) -> str:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()
