"""Which clients of the OPC UA server are trusted: by their certificate, or by that of the authority that signed it."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator
from pathlib import Path

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.validator import CertificateValidator, CertificateValidatorOptions
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.serialization import Encoding

log = logging.getLogger(__name__)
ENDINGS = (".pem", ".crt", ".cer", ".der")


class TrustedClients:
    """Checks the certificate of each client that opens a session.

    Args:
        folder: certificates that are trusted, looked at for each session, so that a change holds at once; None for any client.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = folder
        self._plain = CertificateValidator(CertificateValidatorOptions.BASIC_VALIDATION)

    async def validate(self, certificate: x509.Certificate, application: ua.ApplicationDescription) -> None:
        """Raise `ServiceError` for a certificate that is out of date, is for another application, or is not trusted."""
        if self._folder is None:
            return
        await self._plain.validate(certificate, application)
        if not any(_vouches(known, certificate) for known in _certificates(self._folder)):
            told = hashlib.sha256(certificate.public_bytes(Encoding.DER)).hexdigest()
            name = certificate.subject.rfc4514_string()[:100]
            log.warning("OPC UA: the client %r is not trusted; SHA-256 of its certificate: %s", name, told)
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)


def _vouches(known: x509.Certificate, certificate: x509.Certificate) -> bool:
    """Return whether a certificate is the known one, or was signed by it as by an authority."""
    if known == certificate:
        return True
    try:
        if not known.extensions.get_extension_for_class(x509.BasicConstraints).value.ca:
            return False
        certificate.verify_directly_issued_by(known)
    except (x509.ExtensionNotFound, ValueError, TypeError, InvalidSignature):
        return False
    return True


def _certificates(folder: Path) -> Iterator[x509.Certificate]:
    """Yield the certificates of a folder; a file that is none is logged and passed over."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.suffix.lower() not in ENDINGS:
            continue
        try:
            data = path.read_bytes()
            is_text = data.lstrip().startswith(b"-----BEGIN")
            yield from x509.load_pem_x509_certificates(data) if is_text else [x509.load_der_x509_certificate(data)]
        except (OSError, ValueError) as error:
            log.warning("OPC UA: %s is no certificate: %s", path, error)
