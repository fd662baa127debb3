"""The three TCP ports of an emulated Universal Robots controller."""

from __future__ import annotations

from typing import Any

from drivers.emulators.ports import Peer, TcpPort


class UrPorts:
    """The RTDE, script and dashboard ports as one port; a peer is `(role, connection)`."""

    def __init__(self, *, rtde: int, script: int, dashboard: int) -> None:
        numbers = {"rtde": rtde, "script": script, "dashboard": dashboard}
        self._ports = {role: TcpPort(number) for role, number in numbers.items()}

    @property
    def address(self) -> dict[str, Any]:
        """Return the driver options: host, RTDE port and script port."""
        numbers = {role: port.address["port"] for role, port in self._ports.items()}
        return {"host": "127.0.0.1", "port": numbers["rtde"], "script_port": numbers["script"]}

    @property
    def dashboard_port(self) -> int:
        """Return the port number of the dashboard."""
        return int(self._ports["dashboard"].address["port"])

    def rtde_peers(self) -> tuple[Peer, ...]:
        """Return the open RTDE connections."""
        return self._ports["rtde"].peers

    def receive(self, timeout_s: float) -> list[tuple[Peer, bytes]]:
        """Return what the three ports have received; only the RTDE port waits."""
        waits = {"rtde": timeout_s, "script": 0.0, "dashboard": 0.0}
        return [((role, sock), data) for role, port in self._ports.items() for sock, data in port.receive(waits[role])]

    def send(self, peer: Peer, data: bytes) -> None:
        """Send to one connection, or to every RTDE client if `peer` is None."""
        role, sock = ("rtde", None) if peer is None else peer
        self._ports[role].send(sock, data)

    def vanish(self) -> None:
        """Unplug all three ports."""
        for port in self._ports.values():
            port.vanish()

    def appear(self) -> None:
        """Plug all three ports in again, with the same numbers."""
        for port in self._ports.values():
            port.appear()

    def close(self) -> None:
        """Close all three ports for good."""
        self.vanish()
