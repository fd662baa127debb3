"""Sessions of browsers, which keep a token in a cookie instead of the key."""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from service.access.keys import Key, Keys

SESSION_S = 12 * 3600.0
MAX_SESSIONS = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class _Session:
    key_name: str
    key_hash: str
    ends_s: float


class Sessions:
    """The browsers that have logged in. A session ends with its key, after twelve hours, or with the service.

    Args:
        now: a monotonic clock.
    """

    def __init__(self, *, now: Callable[[], float] = time.monotonic) -> None:
        self._now = now
        self._lock = threading.Lock()
        self._sessions: OrderedDict[str, _Session] = OrderedDict()

    def open(self, key: Key) -> str:
        """Begin a session of a key and return its token; the oldest session ends when there are too many."""
        token = secrets.token_urlsafe(32)
        session = _Session(key_name=key.name, key_hash=key.sha256, ends_s=self._now() + SESSION_S)
        with self._lock:
            self._sessions[token] = session
            while len(self._sessions) > MAX_SESSIONS:
                self._sessions.popitem(last=False)
        return token

    def find(self, token: str, keys: Keys) -> Key | None:
        """Return the key of a session; None when the session has ended, or its key was revoked, replaced or expired."""
        with self._lock:
            session = self._sessions.get(token)
            if session is not None and self._now() >= session.ends_s:
                del self._sessions[token]
                return None
        if session is None:
            return None
        key = keys.named(session.key_name)
        return key if key is not None and key.sha256 == session.key_hash else None

    def close(self, token: str) -> None:
        """End a session; an unknown one is no error."""
        with self._lock:
            self._sessions.pop(token, None)
