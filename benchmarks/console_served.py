"""The real service with its console in processes of their own, and pages of a headless browser, for measuring and pictures."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Error, Page

from service.client import Client
from service.processes.latch import LATCH, Latch

ROOT = Path(__file__).resolve().parents[1]
CHROMIUM_OF_OTHERS = ROOT / "benchmarks/chromium_of_others.sh"
PATIENCE_MS = 150_000
FINAL = ("succeeded", "failed", "cancelled")


@dataclass(frozen=True, slots=True, kw_only=True)
class Served:
    """A running service with its console, and the process that supervises both."""

    url: str
    stop_url: str
    console_url: str
    runs: Path
    client: Client
    latch: Latch

    def console_pid(self) -> int | None:
        """Return the id of the console's process; None while there is none."""
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (folder / "cmdline").read_bytes().split(b"\0")
                if b"service.console.process" in words and self.url.encode() in words:
                    return int(folder.name)
        return None

    def end(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        """Run a task to its end, and return it."""
        task = self.client.post(path, body)
        while task["state"] not in FINAL:
            time.sleep(0.05)
            task = self.client.get(f"/v1/tasks/{task['id']}")
        return dict(task)


def new_page(
    browser: Browser, *, width: int = 1440, height: int = 900, scheme: Any = "light", bypass_csp: bool = False
) -> Page:
    """Return a page in a fresh profile."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, color_scheme=scheme, bypass_csp=bypass_csp
    )
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    return page


def until(page: Page, claim: str, *, every_ms: float = 20.0) -> None:
    """Wait until a JavaScript condition holds.

    Raises:
        TimeoutError: it did not hold in time.
    """
    end_s = time.monotonic() + PATIENCE_MS / 1e3
    while time.monotonic() < end_s:
        with contextlib.suppress(Error):  # the page is being loaded
            if page.evaluate(f"() => {{ try {{ return Boolean({claim}) }} catch {{ return false }} }}"):
                return
        page.wait_for_timeout(every_ms)
    raise TimeoutError(f"{claim}; the page says: {page.inner_text('body')[:2000]}")


@contextmanager
def served(cell: Path, *, runs: Path | None = None) -> Iterator[Served]:
    """Start the real service with its console, wait until both answer, and end them.

    The cell is served as it is, but half of its readings wait for a person, so that there is something to review.

    Args:
        runs: folder of its reports and its history; None for one of its own.
    """
    with tempfile.TemporaryDirectory() as folder:
        text = cell.read_text(encoding="utf-8")
        for name in ("panels", "cells", "missions"):
            (Path(folder) / name).symlink_to(cell.resolve().parents[1] / name)
        own = Path(folder) / "cell.toml"
        review = "" if "[review]" in text else "\n[review]\naudit_share = 0.5\n"
        own.write_text(text + review, encoding="utf-8")
        runs = Path(folder) / "runs" if runs is None else runs
        command = [sys.executable, "-m", "service.cli", "serve", "--cell", str(own), "--port", "0", "--runs", str(runs)]
        command += ["--console-port", "0"]
        temporary = Path(folder) / "t"  # where the service keeps its latch
        temporary.mkdir()
        environment = {**os.environ, "TMPDIR": str(temporary)}
        pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        # It leads a session as under systemd, so that Linux gives its priority to all of it.
        with subprocess.Popen(command, cwd=ROOT, env=environment, start_new_session=True, **pipes) as process:
            assert process.stdout is not None
            told = ""
            while "console at" not in told:
                line = process.stdout.readline()
                if not line:
                    raise RuntimeError(told)
                told += line
            threading.Thread(target=process.stdout.read, daemon=True).start()
            url, stop_url, console_url = (
                _found(pattern, told) for pattern in (r"ready at (\S+)", r"POST (\S+)", r"console at (\S+)")
            )
            client = Client(url=url, timeout_s=120.0)
            (latched,) = temporary.glob(f"panelwright-*/{LATCH}")
            try:
                with Latch(latched) as latch:
                    yield Served(
                        url=url, stop_url=stop_url, console_url=console_url, runs=runs, client=client, latch=latch
                    )
            finally:
                process.terminate()
                process.wait(60.0)


def _found(pattern: str, text: str) -> str:
    found = re.search(pattern, text)
    if found is None:
        raise RuntimeError(text)
    return found[1]
