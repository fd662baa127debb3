"""Asks an ONVIF device for the address of its stream (ONVIF Media service 1.0, WS-UsernameToken with digest)."""

from __future__ import annotations

import base64
import hashlib
import secrets
from datetime import UTC, datetime
from urllib.parse import urlsplit
from xml.etree import ElementTree
from xml.sax.saxutils import escape

import httpx2

from drivers.transport.link import LinkLost, NoAnswer

DEVICE_PATH = "/onvif/device_service"
TIMEOUT_S = 2.0
MOST_BYTES = 1 << 20
DEVICE, MEDIA = "http://www.onvif.org/ver10/device/wsdl", "http://www.onvif.org/ver10/media/wsdl"
SCHEMA = "http://www.onvif.org/ver10/schema"
SECURITY = "http://docs.oasis-open.org/wss/2004/01/oasis-200401-wss"


def stream_address(url: str, login: tuple[str, str] | None) -> str:
    """Return the RTSP address of the first profile of the device at `onvif://HOST[:PORT]`.

    Raises:
        LinkLost: the device cannot be reached or refuses. NoAnswer: it does not answer, or not as ONVIF says.
    """
    parts = urlsplit(url)
    place = f"http://{parts.netloc.rpartition('@')[2]}{parts.path if parts.path.strip('/') else DEVICE_PATH}"
    media = _ask(place, f'<GetCapabilities xmlns="{DEVICE}"><Category>Media</Category></GetCapabilities>', login)
    address = _first(media, "XAddr")
    profiles = _ask(address, f'<GetProfiles xmlns="{MEDIA}"/>', login)
    profile = next((p for p in profiles.iter() if p.tag.endswith("}Profiles")), None)
    token = profile.get("token") if profile is not None else None
    if token is None:
        raise NoAnswer("the ONVIF device has no profile of a stream")
    question = (
        f'<GetStreamUri xmlns="{MEDIA}"><StreamSetup><Stream xmlns="{SCHEMA}">RTP-Unicast</Stream>'
        f'<Transport xmlns="{SCHEMA}"><Protocol>RTSP</Protocol></Transport></StreamSetup>'
        f"<ProfileToken>{escape(token)}</ProfileToken></GetStreamUri>"
    )
    return _first(_ask(address, question, login), "Uri")


def _ask(address: str, question: str, login: tuple[str, str] | None) -> ElementTree.Element:
    envelope = (
        '<?xml version="1.0" encoding="utf-8"?><s:Envelope xmlns:s="http://www.w3.org/2003/05/soap-envelope">'
        f"<s:Header>{_security(*login) if login else ''}</s:Header><s:Body>{question}</s:Body></s:Envelope>"
    )
    headers = {"Content-Type": "application/soap+xml; charset=utf-8"}
    try:
        answer = httpx2.post(address, content=envelope, headers=headers, timeout=TIMEOUT_S, trust_env=False)
    except httpx2.TimeoutException as error:
        raise NoAnswer(f"the ONVIF device at {address} does not answer") from error
    except httpx2.HTTPError as error:
        raise LinkLost(f"the ONVIF device at {address}: {error}") from error
    if answer.status_code != httpx2.codes.OK:
        raise LinkLost(f"the ONVIF device refuses (HTTP status {answer.status_code}): check user and password")
    return _plain_soap(answer.content)


def _plain_soap(content: bytes) -> ElementTree.Element:
    """Parse an answer in UTF-8, given to the parser as text, so that no declared encoding hides a DOCTYPE from the check.

    A zero makes the parser take even text for UTF-16.
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise NoAnswer("the answer of the ONVIF device is not UTF-8") from error
    if len(content) > MOST_BYTES or "<!DOCTYPE" in text or "\0" in text:
        raise NoAnswer("the answer of the ONVIF device is not plain SOAP")
    try:
        return ElementTree.fromstring(text)  # noqa: S314  # entities cannot be declared without a DOCTYPE
    except ElementTree.ParseError as error:
        raise NoAnswer(f"the answer of the ONVIF device is not XML: {error}") from error


def _first(answer: ElementTree.Element, name: str) -> str:
    for element in answer.iter():
        if element.tag.endswith(f"}}{name}") and element.text:
            return element.text.strip()
    raise NoAnswer(f"the answer of the ONVIF device has no {name}")


def _security(user: str, password: str) -> str:
    """Return the header of a WS-UsernameToken: digest = base64(sha1(nonce + created + password))."""
    nonce, created = secrets.token_bytes(16), datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
    digest = hashlib.sha1(nonce + created.encode() + password.encode()).digest()  # noqa: S324  # as the standard says
    name, profile = f"{SECURITY}-wssecurity-secext-1.0.xsd", f"{SECURITY}-username-token-profile-1.0#PasswordDigest"
    return (
        f'<Security xmlns="{name}"><UsernameToken><Username>{escape(user)}</Username>'
        f'<Password Type="{profile}">{base64.b64encode(digest).decode()}</Password>'
        f"<Nonce>{base64.b64encode(nonce).decode()}</Nonce>"
        f'<Created xmlns="{SECURITY}-wssecurity-utility-1.0.xsd">{created}</Created></UsernameToken></Security>'
    )
