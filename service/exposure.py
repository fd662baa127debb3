"""Where a service listens and under which names, and what it refuses: other addresses need keys and an encrypted way."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import socket
import ssl
import stat
from dataclasses import dataclass
from pathlib import Path

from hal.errors import ConfigError
from service.access.keys import KeyBook

LOCAL_NAMES = ("127.0.0.1", "localhost", "::1")
LOOPBACK = ("127.0.0.1", "localhost")
SOCKET_MODE = 0o660  # of the Unix socket: the proxy's group is the service's
REMEDY = "listen on 127.0.0.1 and reach it through ssh -L; or see docs/how-to/deploy.md for keys and TLS"


@dataclass(frozen=True, slots=True, kw_only=True)
class Exposure:
    """Where a service listens.

    Attributes:
        host: address of the TCP port.
        names: further names (or addresses) under which clients reach it, with a port where it is not the usual one.
        tls_cert, tls_key: files in PEM format.
        behind_proxy: whether a proxy with TLS stands before it, whose forwarded host, scheme and client count.
        proxies: addresses of that proxy.
        unix_socket: a socket for that proxy, in addition to the TCP port.
    """

    host: str = "127.0.0.1"
    names: tuple[str, ...] = ()
    tls_cert: Path | None = None
    tls_key: Path | None = None
    behind_proxy: bool = False
    proxies: tuple[str, ...] = ()
    unix_socket: Path | None = None

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine reach it."""
        return self.host in LOOPBACK and not self.behind_proxy

    @property
    def scheme(self) -> str:
        """`https` with a certificate, else `http`."""
        return "https" if self.tls_cert is not None else "http"

    @property
    def stop_host(self) -> str:
        """Address of the stop port, which needs no key and is therefore never reached from elsewhere."""
        return self.host if self.host in LOOPBACK else LOOPBACK[0]

    def url(self, port: int) -> str:
        """Return the address of the API for programs of this machine."""
        host = LOOPBACK[0] if _is_every_address(self.host) else self.host
        return f"{self.scheme}://{host}:{port}"

    def names_at(self, port: int) -> tuple[frozenset[str], frozenset[str]]:
        """Return the hosts (without port) and the web origins under which it is reached."""
        own = {*LOCAL_NAMES, self.host.lower()}
        further = {name.lower() for name in self.names}
        scheme = "https" if self.behind_proxy else self.scheme
        origins = {f"{self.scheme}://{_in_url(name)}:{port}" for name in own}
        for name in further:
            origins |= {f"{scheme}://{_in_url(name)}", f"{scheme}://{_in_url(_bare(name))}:{port}"}
        return frozenset({*own, *map(_bare, further)}), frozenset(origins)

    def proxied_from(self) -> frozenset[str] | None:
        """Return the addresses of the proxy, with "" for the Unix socket; None without a proxy."""
        return (
            frozenset({*self.proxies, *([""] if self.unix_socket is not None else [])}) if self.behind_proxy else None
        )

    def of_console(self) -> list[str]:
        """Return the arguments of the console's process by which it is reached as the service is."""
        given = [("--name", name) for name in sorted({*map(_bare, self.names), self.host.lower()})]
        if self.behind_proxy:
            given += [("--proxy", address) for address in (*self.proxies, "")]
        if self.tls_cert is not None and self.tls_key is not None:
            given += [("--tls-cert", str(self.tls_cert.absolute())), ("--tls-key", str(self.tls_key.absolute()))]
        return [part for pair in given for part in pair] + ([] if self.is_local else ["--exposed"])

    def check(self, book: KeyBook) -> None:
        """Check that strangers cannot use the service.

        Raises:
            ConfigError: names everything that is missing.
            KeysUnusable: the file of keys cannot be used.
        """
        faults = [*self._faults_of_tls(), *self._faults_of_proxy()]
        if not self.is_local:
            if not book.active():
                faults.append(
                    "no valid key, so anybody there could move the arm: `panelwright keys add NAME --role ...`"
                )
            if self.tls_cert is None and not self.behind_proxy:
                faults.append("no TLS, so anybody could read the keys: --tls-cert and --tls-key, or --behind-proxy")
            if _is_every_address(self.host) and not self.names:
                faults.append("no --name, so no Host header can be checked: the name or address that clients use")
        if faults:
            where = "refusing to start" if self.is_local else f"refusing to listen on {self._where()}"
            raise ConfigError(f"{where}: {faults[0]}", hint=REMEDY, faults=faults)

    def _where(self) -> str:
        return f"{self.host} behind a proxy" if self.behind_proxy else self.host

    def _faults_of_tls(self) -> list[str]:
        if (self.tls_cert is None) != (self.tls_key is None):
            return ["--tls-cert and --tls-key belong together"]
        if self.tls_cert is None:
            return []
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(self.tls_cert, self.tls_key)
        except OSError as error:  # also ssl.SSLError: no certificate, or a key of another one
            return [f"certificate {self.tls_cert} with key {self.tls_key} cannot be used: {error}"]
        return []

    def _faults_of_proxy(self) -> list[str]:
        faults = []
        if not self.behind_proxy and (self.proxies or self.unix_socket is not None):
            faults.append("--proxy and --unix-socket need --behind-proxy")
        if self.behind_proxy and not (self.proxies or self.unix_socket is not None):
            faults.append("--behind-proxy needs the proxy's address (--proxy) or a --unix-socket for it")
        if self.behind_proxy and not self.names:
            faults.append("--behind-proxy needs the name under which the proxy is reached (--name)")
        for address in self.proxies:
            with contextlib.suppress(ValueError):
                ipaddress.ip_address(address)
                continue
            faults.append(f"--proxy {address[:60]!r} is no IP address")
        return faults


def unix_socket(path: Path) -> socket.socket:
    """Return a listening socket at `path`, which its user and group may use; one that nobody serves any more is replaced.

    Raises:
        ConfigError: something else is there, another service listens, or the folder cannot be used.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.exists() and (not stat.S_ISSOCK(path.stat().st_mode) or _answers(path)):
            raise FileExistsError("another program uses this path")
        path.unlink(missing_ok=True)
        before = os.umask(0o777 & ~SOCKET_MODE)
        try:
            listener.bind(str(path))
        finally:
            os.umask(before)
        listener.listen(512)
    except OSError as error:
        listener.close()
        raise ConfigError(
            f"the socket {path} cannot be used: {error.strerror or error}", hint="choose another --unix-socket"
        ) from error
    return listener


def _answers(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        return probe.connect_ex(str(path)) == 0


def _is_every_address(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return not host


def _bare(name: str) -> str:
    """Return a name without its port."""
    host, separator, port = name.rpartition(":")
    return host if separator and port.isdigit() and ":" not in host else name


def _in_url(name: str) -> str:
    return f"[{name}]" if name.count(":") > 1 else name
