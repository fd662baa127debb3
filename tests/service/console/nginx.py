"""Runs nginx with the example of the documentation: files and ports of a test in the place of those of a machine."""

from __future__ import annotations

import os
import socket
import subprocess
from pathlib import Path

from tests.service.waiting import eventually

PROGRAM = Path("/usr/sbin/nginx")
PAGE = Path(__file__).parents[3] / "docs/how-to/deploy.md"
BEGIN, END, INCLUDED = "```nginx\n", "```", "# panelwright_proxy\n"
AROUND = """
daemon off;
{user}
pid {folder}/nginx.pid;
error_log {folder}/nginx.log;
events {{ worker_connections 64; }}
http {{
    access_log off;
    client_body_temp_path {folder}/body; proxy_temp_path {folder}/proxy; fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi; scgi_temp_path {folder}/scgi;
{server}
}}
"""


class Nginx:
    """Ends TLS on a free port of this machine; takes the place of `TlsProxy`.

    Args:
        cert, key: files in PEM format.
    """

    def __init__(self, cert: Path, key: Path) -> None:
        self._cert, self._key = cert, key
        self._process: subprocess.Popen[bytes] | None = None
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port: int = free.getsockname()[1]

    def start(self, *, service: Path, console_port: int) -> None:
        """Begin to serve as the example says."""
        folder = self._cert.parent
        server, _, included = PAGE.read_text(encoding="utf-8").partition(BEGIN)[2].partition(END)[0].partition(INCLUDED)
        for old, new in (
            ("listen 8443 ssl", f"listen 127.0.0.1:{self.port} ssl"),
            ("/etc/panelwright/cert.pem", str(self._cert)),
            ("/etc/panelwright/key.pem", str(self._key)),
            ("/run/panelwright/http", str(service)),
            ("127.0.0.1:8462", f"127.0.0.1:{console_port}"),
        ):
            assert server.count(old) == 1, f"the example has no {old}"
            server = server.replace(old, new)
        (folder / "panelwright_proxy").write_text(included)
        user = "user root;" if os.geteuid() == 0 else ""  # its workers read the socket of the test
        file = folder / "nginx.conf"
        file.write_text(AROUND.format(user=user, folder=folder, server=server))
        self._process = subprocess.Popen([PROGRAM, "-c", file, "-p", folder], stderr=subprocess.PIPE)
        eventually(self._is_up)

    def close(self) -> None:
        """End nginx."""
        if self._process is not None:
            self._process.terminate()
            self._process.communicate()

    def _is_up(self) -> bool:
        assert self._process is not None
        if self._process.poll() is not None:
            raise RuntimeError(self._process.communicate()[1].decode())
        with socket.socket() as probe:
            return probe.connect_ex(("127.0.0.1", self.port)) == 0
