"""Who uses the console: each person in their own session with the service, and one mirror of its state for each of them."""

from __future__ import annotations

from collections.abc import Mapping

from hal.errors import CellError
from service.access.keys import Role
from service.console.mirror import ANYBODY, Mirror, Person
from service.console.service_client import QUICK_S, ServiceClient


class People:
    """The persons who use the console now. The console has no right of its own: it asks in the name of each person.

    Args:
        client: a client of the service without a session.
        cookie: name of the cookie in which a browser keeps its session with the service.
    """

    def __init__(self, client: ServiceClient, *, cookie: str) -> None:
        self._client = client
        self._cookie = cookie
        self._mirrors: dict[str, Mirror] = {}

    def start(self) -> None:
        """Begin to ask for everybody in common, in the running event loop; a service without keys needs no more."""
        self._mirror("")

    async def close(self) -> None:
        """End all requests."""
        for mirror in self._mirrors.values():
            mirror.close()
        await self._client.close()

    def client_of(self, cookies: Mapping[str, str]) -> ServiceClient:
        """Return a client that asks in the name of the person whose browser has these cookies."""
        token = cookies.get(self._cookie, "")
        return self._client.in_session(f"{self._cookie}={token}") if token else self._client

    async def enter(self, cookies: Mapping[str, str]) -> Mirror | None:
        """Return the mirror of the person whose browser has these cookies; None if the service asks them to log in."""
        token = cookies.get(self._cookie, "")
        try:
            session = await self.client_of(cookies).get("/v1/session", timeout_s=QUICK_S)
        except CellError:  # the page shows that the service is silent
            return self._mirror(token if token in self._mirrors else "")
        if session["role"] is None:
            return None
        if session["access"] == "open":
            return self._mirror("")
        self._forget()
        mirror = self._mirror(token)
        mirror.person = Person(name=session["name"], role=Role(session["role"]))
        return mirror

    def _mirror(self, token: str) -> Mirror:
        mirror = self._mirrors.get(token)
        if mirror is None:
            mirror = self._mirrors[token] = Mirror(self.client_of({self._cookie: token}), person=ANYBODY)
            mirror.start()
        return mirror

    def _forget(self) -> None:
        """End the mirrors of those who have left and whose missions have ended."""
        for token in [token for token, mirror in self._mirrors.items() if token and mirror.is_left]:
            self._mirrors.pop(token).close()
