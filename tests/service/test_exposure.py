"""A service listens beyond its machine only with keys and an encrypted way, and believes only the proxy that it names."""

from __future__ import annotations

import datetime
import socket
import ssl
from collections.abc import Iterator
from ipaddress import ip_address
from pathlib import Path

import httpx2
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from hal.config import load_cell
from hal.errors import ConfigError
from service.access.keys import KeyBook, Role
from service.client import Client
from service.exposure import Exposure, unix_socket
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.verbs import OPERATIONS

NAME = "cell-3.plant.example"


def certificate(folder: Path, *, name: str = "127.0.0.1") -> tuple[Path, Path]:
    """Write a certificate for a name or address, signed by itself, and its key; return both paths."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
    other = x509.IPAddress(ip_address(name)) if name[0].isdigit() else x509.DNSName(name)
    now = datetime.datetime.now(datetime.UTC)
    built = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject)
        .public_key(key.public_key())
        .serial_number(1)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([other]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem, none = serialization.Encoding.PEM, serialization.NoEncryption()
    (folder / "cert.pem").write_bytes(built.public_bytes(pem))
    (folder / "key.pem").write_bytes(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, none))
    return folder / "cert.pem", folder / "key.pem"


def book_with_key(folder: Path) -> tuple[KeyBook, str]:
    book = KeyBook(folder / ".service" / "keys.json")
    return book, book.add("alice", Role.OPERATOR, valid_s=None, commit=lambda *_row: None)


def faults_of(exposure: Exposure, book: KeyBook) -> str:
    with pytest.raises(ConfigError) as caught:
        exposure.check(book)
    return " | ".join(caught.value.details["faults"])


def test_another_address_needs_keys_and_tls_and_all_that_is_missing_is_told_at_once(tmp_path: Path) -> None:
    everywhere = Exposure(host="0.0.0.0")  # noqa: S104 - what is refused
    told = faults_of(everywhere, KeyBook(tmp_path / "keys.json"))
    assert "no valid key" in told and "no TLS" in told and "no --name" in told
    book, _ = book_with_key(tmp_path)
    assert "no valid key" not in (told := faults_of(everywhere, book)) and "no TLS" in told
    cert, key = certificate(tmp_path)
    Exposure(host="10.0.0.5", tls_cert=cert, tls_key=key).check(book)
    book.revoke("alice", commit=lambda *_row: None)
    assert "no valid key" in faults_of(Exposure(host="10.0.0.5", tls_cert=cert, tls_key=key), book)


def test_a_proxy_needs_a_name_an_address_and_keys(tmp_path: Path) -> None:
    none = KeyBook(tmp_path / "keys.json")
    told = faults_of(Exposure(behind_proxy=True, proxies=("nginx",)), none)
    assert "no IP address" in told and "--name" in told and "no valid key" in told and "TLS" not in told
    assert "--proxy" in faults_of(Exposure(behind_proxy=True, names=(NAME,)), none)
    assert "need --behind-proxy" in faults_of(Exposure(proxies=("10.0.0.1",)), none)
    book, _ = book_with_key(tmp_path)
    Exposure(behind_proxy=True, names=(NAME,), unix_socket=tmp_path / "socket").check(book)


def test_a_certificate_that_cannot_be_used_is_refused_at_the_start(tmp_path: Path) -> None:
    book, _ = book_with_key(tmp_path)
    cert, key = certificate(tmp_path)
    assert "belong together" in faults_of(Exposure(tls_cert=cert), book)
    key.write_text("nothing")
    assert "cannot be used" in faults_of(Exposure(tls_cert=cert, tls_key=key), book)


def test_loopback_needs_nothing(tmp_path: Path) -> None:
    Exposure().check(KeyBook(tmp_path / "keys.json"))
    assert Exposure(host="10.0.0.5").stop_host == "127.0.0.1", "the stop port needs no key, so it stays on this machine"


def test_a_socket_that_nobody_serves_any_more_is_replaced_and_another_file_is_not(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    first = unix_socket(path)
    assert path.stat().st_mode & 0o777 == 0o660
    with pytest.raises(ConfigError, match="another program"):
        unix_socket(path)
    first.close()
    unix_socket(path).close()
    path.unlink()
    path.write_text("a file")
    with pytest.raises(ConfigError, match="another program"):
        unix_socket(path)


@pytest.fixture(scope="module")
def proxied(
    write_module_cell: WriteCell, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Panelwright, str]]:
    """Yield a service with TLS behind a proxy at 127.0.0.2 and on a Unix socket, and an operator's key."""
    runs = tmp_path_factory.mktemp("runs")
    _, key = book_with_key(runs)
    cert, tls_key = certificate(runs)
    exposure = Exposure(
        names=(NAME,),
        tls_cert=cert,
        tls_key=tls_key,
        behind_proxy=True,
        proxies=("127.0.0.2",),
        unix_socket=runs / "socket",
    )
    options = Options(port=0, runs_dir=runs, inline=True, exposure=exposure)
    server = Panelwright(load_cell(write_module_cell(robot=True)), options, operations=OPERATIONS)
    server.start()
    yield server, key
    server.close()


def test_tls_is_spoken_and_the_client_checks_the_certificate(proxied: tuple[Panelwright, str], tmp_path: Path) -> None:
    server, key = proxied
    cert = server.service.runs_dir / "cert.pem"
    assert server.url.startswith("https://")
    assert Client(url=server.url, key=key, ca=cert).get("/v1/info")["access"] == "keys"
    with pytest.raises(ConfigError, match="no certificate"):
        Client(url=server.url, key=key, ca=tmp_path / "none").get("/v1/info")
    other, _ = certificate(tmp_path)
    with pytest.raises(Exception, match="certificate"):
        Client(url=server.url, key=key, ca=other).get("/v1/info")


def ask(server: Panelwright, source: str, method: str, headers: dict[str, str]) -> httpx2.Response:
    """Ask from an address of this machine, or over the Unix socket for the source "socket"."""
    trusted = ssl.create_default_context(cafile=server.service.runs_dir / "cert.pem")
    if source == "socket":
        way = httpx2.HTTPTransport(uds=str(server.service.runs_dir / "socket"), verify=trusted)
    else:
        way = httpx2.HTTPTransport(local_address=source, verify=trusted)
    with httpx2.Client(transport=way, base_url=server.url, trust_env=False) as http:
        return http.request(method, "/v1/lease", headers=headers, json={"holder": "x"} if method == "POST" else None)


@pytest.mark.parametrize("source", ["127.0.0.2", "socket"])
def test_the_proxys_host_and_origin_count(proxied: tuple[Panelwright, str], source: str) -> None:
    server, key = proxied
    told = {"X-Forwarded-Host": NAME, "X-Forwarded-Proto": "https", "X-Forwarded-For": "10.9.8.7"}
    with_key = {**told, "Authorization": f"Bearer {key}"}
    assert ask(server, source, "GET", with_key).status_code == 200
    assert ask(server, source, "GET", told).status_code == 401
    assert ask(server, source, "GET", {**with_key, "X-Forwarded-Host": "evil.example"}).status_code == 400
    assert ask(server, source, "POST", {**with_key, "Origin": "https://evil.example"}).status_code == 403
    done = ask(server, source, "POST", {**with_key, "Origin": f"https://{NAME}"})
    assert done.status_code == 200
    server.service.lease.release(done.json()["token"])


def test_a_strangers_forwarded_headers_do_not_count(proxied: tuple[Panelwright, str]) -> None:
    server, key = proxied
    headers = {"Authorization": f"Bearer {key}", "X-Forwarded-Host": "evil.example", "X-Forwarded-For": "10.9.8.7"}
    assert ask(server, "127.0.0.1", "GET", headers).status_code == 200, "the Host header itself is right"
    assert ask(server, "127.0.0.1", "GET", {**headers, "Host": NAME}).status_code == 200
    assert ask(server, "127.0.0.1", "GET", {**headers, "Host": "evil.example"}).status_code == 400


def test_a_stop_through_the_proxy_needs_a_key_and_the_stop_port_does_not(proxied: tuple[Panelwright, str]) -> None:
    server, key = proxied
    trusted = ssl.create_default_context(cafile=server.service.runs_dir / "cert.pem")
    told = {"X-Forwarded-Host": NAME}
    way = httpx2.HTTPTransport(uds=str(server.service.runs_dir / "socket"), verify=trusted)
    with httpx2.Client(transport=way, base_url=server.url, trust_env=False) as http:
        assert http.post("/v1/stop", headers=told).status_code == 401
        answer = http.post("/v1/stop", headers={**told, "Authorization": f"Bearer {key}"})
        assert answer.status_code == 200 and answer.json()["stop_url"] == "/v1/stop"
    assert Client(url=f"http://127.0.0.1:{server.stop_port}").post("/v1/stop")["is_latched"]
    with socket.socket() as plain:
        plain.connect(("127.0.0.1", server.port))
        plain.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert not plain.recv(100).startswith(b"HTTP/1.1 200")
