"""Checks, before anything starts, that what the outlets of a cell file need is there."""

from __future__ import annotations

import stat
from importlib.util import find_spec
from pathlib import Path

from hal.errors import ConfigError
from hal.outlets import OutletsSection

EXTRAS = {"mqtt": ("aiomqtt", "mqtt")}  # outlet: package, extra
SECRETS = (("mqtt", "password_file"), ("webhook", "secret_file"))
FILES = (*SECRETS, ("mqtt", "ca_file"))


def checked_outlets(section: OutletsSection, folder: Path) -> OutletsSection:
    """Return the section with absolute paths; relative ones start at the cell file's folder.

    Raises:
        ConfigError: a package is not installed, or a file is missing, empty, or open to other users.
    """
    for outlet, (package, extra) in EXTRAS.items():
        if getattr(section, outlet) is not None and find_spec(package) is None:
            raise ConfigError(
                f"outlets.{outlet} needs the package {package}, which is not installed",
                hint=f"install the extra `{extra}`: pip install 'panelwright[{extra}]'",
                key=f"outlets.{outlet}",
            )
    for outlet, key in FILES:
        part = getattr(section, outlet)
        if part is None or getattr(part, key) is None:
            continue
        path = (folder / getattr(part, key)).absolute()
        _check_file(path, f"outlets.{outlet}.{key}", is_secret=(outlet, key) in SECRETS)
        section = section.model_copy(update={outlet: part.model_copy(update={key: str(path)})})
    return section


def _check_file(path: Path, key: str, *, is_secret: bool) -> None:
    try:
        mode, is_empty = path.stat().st_mode, not path.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{key}: {path} cannot be read: {error}", hint="name another file", key=key) from error
    if is_empty:
        raise ConfigError(f"{key}: {path} is empty", hint="write the secret into it", key=key)
    if is_secret and mode & (stat.S_IRWXG | stat.S_IRWXO):
        raise ConfigError(f"{key}: other users may access {path}", hint=f"chmod 600 {path}", key=key)
