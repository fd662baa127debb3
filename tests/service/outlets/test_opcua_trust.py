"""Tests of the trust list of the OPC UA server."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from service.outlets.opcua import NAMESPACE
from service.outlets.opcua_trust import _vouches
from tests.service.outlets.fakes import FakeSource
from tests.service.outlets.test_opcua import is_status, rsa_certificate, serving, until


def test_only_clients_whose_certificate_is_in_the_trust_list_connect_and_a_change_holds_at_once(tmp_path: Path) -> None:
    trusted = tmp_path / "trusted"
    for name in ("server", "known", "stranger", "trusted"):
        (tmp_path / name).mkdir()
    cert, key = rsa_certificate(tmp_path / "server")
    (trusted / "notes.txt").write_text("not a certificate")
    (trusted / "torn.pem").write_text("-----BEGIN CERTIFICATE-----\ntorn\n")

    async def connects(url: str, folder: str, *, uri: str = NAMESPACE.format(cell="bench")) -> bool:
        own, own_key = rsa_certificate(tmp_path / folder) if not list((tmp_path / folder).iterdir()) else paths(folder)
        client = Client(url)
        client.application_uri = uri
        await client.set_security(SecurityPolicyBasic256Sha256, str(own), str(own_key), server_certificate=str(cert))
        try:
            async with client:
                await until(client, "pressure.value", is_status(ua.StatusCodes.Good))
        except ua.UaError:
            return False
        return True

    def paths(folder: str) -> tuple[Path, Path]:
        return tmp_path / folder / "cert.pem", tmp_path / folder / "key.pem"

    async def story() -> None:
        source = FakeSource()
        source.reads(4.5)
        given = {"certificate_file": str(cert), "private_key_file": str(key), "trusted_clients": str(trusted)}
        async with serving(source, **given) as url:
            assert not await connects(url, "known"), "nobody is trusted yet"
            (trusted / "known.pem").write_bytes(paths("known")[0].read_bytes())
            assert await connects(url, "known")
            assert not await connects(url, "stranger")
            assert not await connects(url, "known", uri="urn:another:application")
            (trusted / "known.pem").unlink()
            assert not await connects(url, "known"), "taken from the list, it is refused at once"

    asyncio.run(story())


def test_an_authority_of_the_trust_list_vouches_for_its_clients_and_a_client_for_nobody() -> None:
    key, other = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    authority = signed("authority", key, by="authority", by_key=key, is_authority=True)
    client = signed("client", other, by="authority", by_key=key)
    assert _vouches(authority, client)
    assert not _vouches(signed("authority", other, by="authority", by_key=other, is_authority=True), client)
    assert not _vouches(signed("authority", key, by="authority", by_key=key), client), "it is no authority"


def signed(name: str, key: Any, *, by: str, by_key: Any, is_authority: bool = False) -> x509.Certificate:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .issuer_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, by)]))
        .public_key(key.public_key())
        .serial_number(7)
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        .sign(by_key, hashes.SHA256())
    )
