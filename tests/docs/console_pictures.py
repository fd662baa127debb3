"""Takes the pictures of the console's pages that the documentation shows: `make pictures` renews those in `docs/images/console`.

Runs a simulated week of rounds, starts the real service on what it leaves, and takes each page in headless Chromium.
`python -m tests.docs.console_pictures --all --out FOLDER` takes each page in light and dark, 1440 and 390 pixels wide.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

from benchmarks.console_served import Served, new_page, served, until
from hal.arrays import Image
from tests.service.browser import CHROMIUM, FLAGS

ROOT = Path(__file__).resolve().parents[2]
PICTURES_OF_DOCS = ROOT / "docs/images/console"
SHOWN = (("", 1440, 900, "light"), ("-telephone", 390, 844, "dark"))
OTHERS = (("-dark", 1440, 900, "dark"), ("-telephone-light", 390, 844, "light"))
QUALITY = 70
SETTLE_MS = 2500.0
# A drawing in 3-D loads its parts one by one; the points come last. NiceGUI shows tests the scene as `scene_...`.
POINTS_DRAWN = """Object.entries(window).filter(([name]) => name.startsWith('scene_')).some(([, scene]) => {
    let found = false
    scene.traverse(part => { found ||= Boolean(part.isPoints) })
    return found
})"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Take the pictures and print their sizes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=PICTURES_OF_DOCS)
    parser.add_argument("--days", type=float, default=7.0, help="length of the simulated week")
    parser.add_argument("--only", default=",".join(PICTURES))
    parser.add_argument("--all", action="store_true", help="every page in every look, in its whole length")
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    with after_a_week(given.days) as (service, browser):
        for name in given.only.split(","):
            for suffix, width, height, scheme in (*SHOWN, *OTHERS) if given.all else SHOWN:
                path = given.out / f"{name}{suffix}.webp"
                page = new_page(browser, width=width, height=height, scheme=scheme)
                pixels = taken(page, service, name, whole=given.all)
                cv2.imwrite(str(path), pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
                print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB", flush=True)
    return 0


@contextmanager
def after_a_week(days: float) -> Iterator[tuple[Served, Browser]]:
    """Start the service on the history of a simulated week, or of so many days, and a browser."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "service.cli", "demo", "--week", "--days", str(days), "--runs", folder]
        subprocess.run(command, cwd=ROOT, check=True)
        runs = Path(folder) / "week"
        with served(runs / "plant/cells/bench.toml", runs=runs) as service, sync_playwright() as play:
            service.end("/v1/panel-pose", {})
            browser = play.chromium.launch(executable_path=str(CHROMIUM), args=FLAGS)
            yield service, browser
            browser.close()


def taken(page: Page, service: Served, name: str, *, whole: bool = False) -> Image:
    """Show what a picture is of on a new page, and return it as BGR pixels; the page is closed afterwards."""
    path, prepare = PICTURES[name]
    page.goto(service.console_url + path)
    until(page, "document.querySelector('.top .quiet').textContent.includes('panel')")
    prepare(page, service)
    page.wait_for_timeout(SETTLE_MS)
    pixels = cv2.imdecode(np.frombuffer(page.screenshot(full_page=whole), np.uint8), cv2.IMREAD_COLOR)
    page.context.close()
    assert pixels is not None  # the browser wrote it
    return np.asarray(pixels, dtype=np.uint8)


def _nothing(_page: Page, _service: Served) -> None:
    """Show the page as it opens."""


def _drawn(page: Page, _service: Served) -> None:
    until(page, "document.querySelector('img[data-source]').naturalWidth > 0")


def _opened(page: Page, _service: Served) -> None:
    page.click("g[data-object=pressure]")
    until(page, "document.querySelector('.dialog svg, .dialog .crops') !== null")


def _planned(page: Page, _service: Served) -> None:
    page.click("[data-mission=inspect]")
    page.click("button:text-is('Dry run'):not([disabled])")
    until(page, "document.querySelector('.main').textContent.includes('Plan of')")


def _several(page: Page, _service: Served) -> None:
    until(page, "document.querySelector('.nicegui-echart canvas') !== null")
    page.click("button[data-object=temperature]")
    until(page, "document.querySelector('tbody').textContent.includes('TEMPERATURE')")


def _checked(page: Page, _service: Served) -> None:
    until(page, "document.querySelector('.main').textContent.includes('It has no fault')")


def _pointed(page: Page, service: Served) -> None:
    """Show the way of a dry run and the scanner's points."""
    service.end("/v1/missions", {"file": "inspect", "dry_run": True})
    until(page, "document.querySelector('.main').textContent.includes('The green way')")
    page.click('button:text-is("Show the scanner\'s points")')
    until(page, POINTS_DRAWN)


def _uploaded(page: Page, _service: Served) -> None:
    until(page, "document.querySelector('#known').textContent.includes('kinds')")
    page.set_input_files("#file", ROOT / "docs/images/teach-mushroom.png")
    until(page, "document.querySelector('#picture').naturalWidth > 0")
    size = page.locator("#picture").bounding_box()
    assert size is not None
    scale = size["width"] / page.evaluate("document.querySelector('#picture').naturalWidth")
    page.click("#picture", position={"x": 522 * scale, "y": 334 * scale})
    until(page, "/^(Found|No outline)|: /.test(document.querySelector('#found').textContent)")


PICTURES: dict[str, tuple[str, Callable[[Page, Served], None]]] = {
    "panel": ("/", _drawn),
    "object": ("/", _opened),
    "missions": ("/missions", _planned),
    "rounds": ("/rounds", _nothing),
    "alarms": ("/alarms", _nothing),
    "review": ("/review", _nothing),
    "history": ("/history?object=pressure", _several),
    "devices": ("/devices", _nothing),
    "setup": ("/setup", _nothing),
    "teach": ("/teach", _uploaded),
    "cell": ("/cell", _pointed),
    "mission-editor": ("/mission-editor?mission=demo", _checked),
}

if __name__ == "__main__":
    raise SystemExit(main())
