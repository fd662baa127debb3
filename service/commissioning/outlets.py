"""Checks, before anything starts, that what the outlets of a cell file need is there."""

from __future__ import annotations

import stat
from importlib.util import find_spec
from pathlib import Path

from hal.outlets import OutletsSection
from hal.strict import FieldFault, refusal

EXTRAS = {
    "mqtt": ("aiomqtt", "mqtt"),
    "sparkplug": ("aiomqtt", "mqtt"),
    "opcua": ("asyncua", "opcua"),
}  # outlet: package, extra
SECRETS = (
    ("mqtt", "password_file"),
    ("sparkplug", "password_file"),
    ("webhook", "secret_file"),
    ("opcua", "password_file"),
    ("opcua", "private_key_file"),
    ("opcua", "key_file"),
)
FILES = (*SECRETS, ("mqtt", "ca_file"), ("sparkplug", "ca_file"), ("opcua", "certificate_file"))


def checked_outlets(section: OutletsSection, folder: Path, *, source: str = "[outlets]") -> OutletsSection:
    """Return the section with absolute paths; relative ones start at the cell file's folder.

    Args:
        source: the cell file's name, for errors.

    Raises:
        ConfigError: packages are not installed, or files are missing, empty, or open to other users; names all of them.
    """
    faults = []
    for outlet, (package, extra) in EXTRAS.items():
        if getattr(section, outlet) is not None and find_spec(package) is None:
            text = f"needs the package {package}, which is not installed"
            hint = f"install the extra `{extra}`: pip install 'panelwright[{extra}]'"
            faults.append(FieldFault(f"outlets.{outlet}", text, hint))
    for outlet, key in FILES:
        part = getattr(section, outlet)
        if part is None or getattr(part, key) is None:
            continue
        path = (folder / getattr(part, key)).absolute()
        faults += _file_faults(path, f"outlets.{outlet}.{key}", is_secret=(outlet, key) in SECRETS)
        section = section.model_copy(update={outlet: part.model_copy(update={key: str(path)})})
    if section.opcua is not None and section.opcua.trusted_clients is not None:
        clients = (folder / section.opcua.trusted_clients).absolute()
        if not clients.is_dir():
            hint = "make it, and put the certificates of the clients into it"
            faults.append(FieldFault("outlets.opcua.trusted_clients", f"there is no folder {clients}", hint))
        section = section.model_copy(
            update={"opcua": section.opcua.model_copy(update={"trusted_clients": str(clients)})}
        )
    if faults:
        raise refusal(faults, source=source)
    return section


def _file_faults(path: Path, key: str, *, is_secret: bool) -> list[FieldFault]:
    try:
        mode, is_empty = path.stat().st_mode, not path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        return [FieldFault(key, f"{path} cannot be read: {error}", "name another file")]
    if is_empty:
        return [FieldFault(key, f"{path} is empty", "write the secret into it")]
    if is_secret and mode & (stat.S_IRWXG | stat.S_IRWXO):
        return [FieldFault(key, f"other users may access {path}", f"chmod 600 {path}")]
    return []
