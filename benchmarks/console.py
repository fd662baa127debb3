"""The console in a real browser beside the real service: `python -m benchmarks.console [--readings 20] [--kills 50] [--cell FILE]`.

Starts `panelwright serve` and headless Chromium, and measures: from a click to the value on the page without the time of the
reading; the event loop of the service and its stops beside a mission with ten browsers; how many places of a moving arm reach ten
browsers that show the cell in 3-D; how soon a page is painted and of use; axe violations over all pages; clicks for four jobs; and
missions that a killed console harms (half an hour, because its pauses grow). The browsers share the processors evenly with the
service; with `--yielding` they get what it leaves, as if they ran on other machines. Prints a table with the pass lines, and
returns 1 if one is missed.
`--only latency,crowd,scene,paint,axe,clicks,kills` chooses.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright
from websockets.sync.client import connect

from benchmarks.console_jobs import JOBS
from benchmarks.console_served import CHROMIUM_OF_OTHERS, FINAL, Served, new_page, served, until
from hal.arrays import Array
from hal.geometry import from_json
from tests.service.browser import CHROMIUM, CONSOLE_PAGES, FLAGS, OWN_PAGES, barriers

ROOT = Path(__file__).resolve().parents[1]
SIZES, SCHEMES = ((1440, 900), (390, 844)), ("light", "dark")
BROWSERS = 10
LONGEST_S = 5.0
SEEN = """(name) => { window.seenMs = null;
  const row = () => document.querySelector(`g[data-object=${name}]`)?.dataset.row;
  const before = row();
  const look = () => { if (row() !== before) window.seenMs = Date.now(); else requestAnimationFrame(look); };
  look(); }"""
FACTS = "document.querySelector('.dialog time[data-utc]')?.dataset.utc"
SEEN_IN_DIALOG = f"""() => {{ window.seenMs = window.clickMs = null; const before = {FACTS};
  addEventListener('click', () => {{ window.clickMs ??= Date.now(); }}, {{ capture: true, once: true }});
  const look = () => {{ if ({FACTS} !== before) window.seenMs = Date.now(); else requestAnimationFrame(look); }};
  look(); }}"""
PAINT = """() => ({ first: performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? null })"""
KEEP_MOVES = """if (!window.moves) window.socket.onAny((event, said) => {
  for (const [, id, place] of (said?.code ?? '').matchAll(/"move", ?\\["([^"]+)",([^\\]]+)/g))
    (window.moves[id] ??= []).push([Date.now() / 1e3, ...place.split(',').map(Number)]); });
  window.moves = {};"""
DRAW_NOTHING = "getElement(Number(document.querySelector('.scene').id.slice(1))).renderer.render = () => {};"
DRAWN_DIGITS, LEAST_SAMPLES = 3, 30  # the drawing is rounded to a millimetre
SAME_PLACE_M = 0.0015
MISSIONS_IN_3D = 4
CONNECTED = "document.querySelector('.top .quiet').textContent.includes('panel')"
USABLE = (
    "document.querySelector('#stop-box')?.dataset.latched === 'no' && document.querySelector('g[data-object]') !== null"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Line:
    """One line of the printed table."""

    what: str
    measured: str
    wanted: str
    is_met: bool


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readings", type=int, default=20)
    parser.add_argument("--missions", type=int, default=8)
    parser.add_argument("--loads", type=int, default=10)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--stops", type=int, default=200)
    parser.add_argument("--only", default=",".join(PARTS))
    parser.add_argument(
        "--yielding", action="store_true", help="browsers get what the service leaves, as on other machines"
    )
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    given = parser.parse_args(arguments)
    lines: list[Line] = []
    print(f"load {os.getloadavg()[0]:.1f} at the start")
    with served(given.cell) as service, sync_playwright() as play:
        program = CHROMIUM_OF_OTHERS if given.yielding else CHROMIUM
        browser = play.chromium.launch(executable_path=str(program), args=FLAGS)
        service.end("/v1/missions", {"file": "inspect"})
        for part in given.only.split(","):
            print(f"{part} ...", flush=True)
            lines += PARTS[part](service, browser, given)
            for line in lines[-4:]:
                print(f"  {line.what}: {line.measured}", flush=True)
        browser.close()
    print(f"load {os.getloadavg()[0]:.1f} at the end\n\n| figure | measured | pass | |\n| --- | --- | --- | --- |")
    for line in lines:
        print(f"| {line.what} | {line.measured} | {line.wanted} | {'met' if line.is_met else 'MISSED'} |")
    return int(not all(line.is_met for line in lines))


def latency(service: Served, browser: Browser, given: argparse.Namespace) -> Iterator[Line]:
    """Measure what the console adds to a reading: from the click to the task, and from its end to the value on the page."""
    page, watcher = new_page(browser), new_page(browser)
    for one in (page, watcher):
        one.goto(service.console_url)
        until(one, USABLE)
    page.click("g[data-object=pressure]")
    page.wait_for_selector("button:text-is('Read now')")
    added_s, passive_s = [], []
    for _ in range(given.readings):
        page.evaluate(SEEN_IN_DIALOG)
        watcher.evaluate(SEEN, "pressure")
        page.click("button:text-is('Read now')")
        for one in (page, watcher):
            until(one, "window.seenMs !== null")
        clicked_s, seen_s = (page.evaluate(f"window.{name}Ms") / 1e3 for name in ("click", "seen"))
        reading = next(r for r in service.client.get("/v1/history")["newest"] if r["object"] == "pressure")
        task = service.client.get(f"/v1/tasks/{reading['task']}")
        added_s.append((task["created_s"] - clicked_s) + max(0.0, seen_s - reading["utc_s"]))
        passive_s.append(watcher.evaluate("window.seenMs") / 1e3 - reading["utc_s"])
        while service.client.get(f"/v1/tasks/{reading['task']}")["state"] not in FINAL:
            time.sleep(0.05)
        until(page, "document.querySelector('.dialog').textContent.includes('done. It shows')")
    for one in (page, watcher):
        one.context.close()
    yield _at_most(
        "click to value, without the reading itself, p95", 1e3 * float(np.quantile(added_s, 0.95)), 300, "ms"
    )
    yield _at_most("reading stored to value on another page, p95", 1e3 * float(np.quantile(passive_s, 0.95)), 300, "ms")


def crowd(service: Served, browser: Browser, given: argparse.Namespace) -> Iterator[Line]:
    """Measure event loop and stops beside a mission that ten browsers follow on different pages."""
    pages = [new_page(browser) for _ in range(BROWSERS)]
    for page, path in zip(pages, [*CONSOLE_PAGES, "/"], strict=False):
        page.goto(service.console_url + path)
    for page in pages:
        until(page, "document.querySelector('#stop-box').dataset.latched === 'no'")
    timers, outcomes = np.zeros(2), list[str]()
    for _ in range(given.missions):
        before = _timers(service)
        task = service.client.post("/v1/missions", {"file": "demo"})
        while service.client.get(f"/v1/tasks/{task['id']}")["state"] not in FINAL:
            pages[0].wait_for_timeout(100)
        timers += _timers(service) - before
        outcomes.append(service.client.get(f"/v1/tasks/{task['id']}")["state"])
    lag_s = float(service.client.get("/v1/info")["event_loop_lag_p99_s"])
    stops_s = np.array([_stop(service) for _ in range(given.stops)])
    for page in pages:
        page.context.close()
    succeeded = outcomes.count("succeeded")
    yield _at_least("demo missions beside ten browsers that succeeded", succeeded, given.missions, "")
    late = 1e2 * timers[0] / timers[1]
    yield _at_most(f"timers of the event loop during these that were over 10 ms late, of {timers[1]:.0f}", late, 1, "%")
    yield _at_most("event-loop lag in the minute that ends with the last of these, p99", 1e3 * lag_s, 10, "ms")
    yield _at_most(
        f"stop to latch beside ten browsers, p99 of {given.stops}", 1e3 * float(np.quantile(stops_s, 0.99)), 10, "ms"
    )


def scene(service: Served, browser: Browser, _given: argparse.Namespace) -> Iterator[Line]:
    """Measure how many of the places of a moving arm reach ten browsers that show the cell in 3-D, and how late."""
    pages = [new_page(browser) for _ in range(BROWSERS)]
    for page in pages:
        page.goto(service.console_url + "/cell")
        until(page, "window.did_handshake && document.body.textContent.includes('Contact force')")
    pages[0].wait_for_timeout(5000)  # all of them have drawn the cell
    for where, change in (("here", ""), ("elsewhere", DRAW_NOTHING)):
        for page in pages:
            page.evaluate(f"() => {{ {change} {KEEP_MOVES} }}")
        rate_hz, told = _places(service, pages[0])
        delays_s = [_delays_s(told, page) for page in pages]
        in_3d = f"cell in 3-D, {BROWSERS} browsers that draw {where}"
        yield _at_least(f"{in_3d}: states of the robot told to a client beside them", rate_hz, 19.4, "a second")
        share = min(len(one) for one in delays_s) / len(told)
        yield _at_least(f"{in_3d}: share of {len(told)} places that reach each, least", share, 0.97, "")
        later_ms = 1e3 * float(np.quantile(np.concatenate(delays_s), 0.95))
        yield Line(
            what=f"{in_3d}: later than at that client, p95", measured=f"{later_ms:.0f} ms", wanted="-", is_met=True
        )
    for page in pages:
        page.context.close()


def _places(service: Served, page: Page) -> tuple[float, Array]:
    """Let the arm move and wait until all of it was told.

    Returns:
        How many states a second the stream told, and the places of the arm's end: rows of UTC time, s, and x, y, z, m (N, 4).
    """
    with _samples(service) as samples:
        begun_s = time.monotonic()
        tasks = [service.end("/v1/missions", {"file": "inspect"}) for _ in range(MISSIONS_IN_3D)]
        taken_s = time.monotonic() - begun_s
    page.wait_for_timeout(1000)
    ends_m = [from_json(sample["base_from_flange"]).translation for _, sample in samples]
    places = np.column_stack([[utc_s for utc_s, _ in samples], np.round(ends_m, DRAWN_DIGITS)])
    told = places[1:][np.diff(places[:, 1:], axis=0).any(axis=1)]
    if len(told) < LEAST_SAMPLES or any(task["state"] != "succeeded" for task in tasks):
        raise RuntimeError(f"the arm went to {len(told)} places only: {[task['problem'] for task in tasks]}")
    return len(samples) / taken_s, told


def _delays_s(told: Array, page: Page) -> Array:
    """Return how much later than at the stream's client the places of the arm's end reached a browser, s; not the missing ones."""
    moves: dict[str, list[list[float]]] = page.evaluate("window.moves")
    return max(
        (_delays_of(told, places) for places in moves.values()), key=len
    )  # those of the part that is the arm's end


def _delays_of(told: Array, places: list[list[float]]) -> Array:
    """Return the delays of one part of the drawing, s; only places that follow each other as they were told count."""
    delays, next_row = [], 0
    for seen_s, *place in places:
        same = np.flatnonzero(np.abs(told[next_row:, 1:] - place).max(axis=1) < SAME_PLACE_M)
        if len(same):
            next_row += int(same[0]) + 1
            delays.append(seen_s - told[next_row - 1, 0])
    return np.array(delays)


@contextmanager
def _samples(service: Served) -> Iterator[list[tuple[float, dict[str, Any]]]]:
    """Yield the list to which the states of the robot are added as the service streams them, each with the UTC time, s."""
    samples: list[tuple[float, dict[str, Any]]] = []
    with connect(f"{service.url.replace('http', 'ws', 1)}/v1/stream", proxy=None) as stream:
        reader = threading.Thread(
            target=lambda: samples.extend(
                (time.time(), one) for text in stream if "position_rad" in (one := json.loads(text))
            )
        )
        reader.start()
        yield samples
    reader.join()


def paint(service: Served, browser: Browser, given: argparse.Namespace) -> Iterator[Line]:
    """Measure the first paint, and when drawing and stop of the panel's page are there, in fresh browser profiles."""
    first_s, usable_s = [], []
    for _ in range(given.loads):
        page = new_page(browser)
        begun_s = time.perf_counter()
        page.goto(service.console_url, wait_until="commit")
        until(page, USABLE, every_ms=10)
        usable_s.append(time.perf_counter() - begun_s)
        first_s.append(page.evaluate(PAINT)["first"] / 1e3)
        page.context.close()
    yield _at_most(f"first paint, median of {given.loads}", float(np.median(first_s)), 1.5, "s")
    yield _at_most(f"usable, median of {given.loads}", float(np.median(usable_s)), 3.0, "s")


def axe(service: Served, browser: Browser, _given: argparse.Namespace) -> Iterator[Line]:
    """Count axe violations over all pages of console and service and a report, light and dark, at both widths."""
    service.end("/v1/missions", {"file": "inspect"})
    name = service.client.get("/v1/missions")["missions"][0]["name"]
    pages = {
        **{service.console_url + path: CONNECTED for path in CONSOLE_PAGES},
        **{service.url + path: f"document.querySelector('{sign}') !== null" for path, sign in OWN_PAGES.items()},
        f"{service.url}/v1/missions/{name}/report.html": "document.querySelector('.appendix') !== null",
    }
    found: list[str] = []
    for width, height in SIZES:
        for scheme in SCHEMES:
            page = new_page(browser, width=width, height=height, scheme=scheme, bypass_csp=True)
            for url, is_there in pages.items():
                page.goto(url)
                until(page, is_there)
                page.wait_for_timeout(1000)
                found += [f"{url} {width} {scheme}: {barrier}" for barrier in barriers(page)]
            page.context.close()
    for fault in found:
        print(f"  {fault}")
    yield _at_most(f"axe violations, {len(pages)} pages, light and dark, 1440 and 390 px", len(found), 0, "")


def clicks(service: Served, browser: Browser, _given: argparse.Namespace) -> Iterator[Line]:
    """Do four jobs from the panel's page as a person does, and count the clicks."""
    for name, job in JOBS.items():
        page = new_page(browser)
        page.goto(service.console_url)
        until(page, USABLE)
        page.evaluate(
            "() => { window.clicks = 0; addEventListener('click', () => { sessionStorage.clicks = ++window.clicks; }, true); }"
        )
        page.evaluate("() => { sessionStorage.clicks = 0; }")
        job(page, service.client, until)
        yield _at_most(f"clicks: {name}", float(page.evaluate("Number(sessionStorage.clicks)")), 3, "")
        page.context.close()


def kills(service: Served, _browser: Browser, given: argparse.Namespace) -> Iterator[Line]:
    """Kill the console again and again while missions run; count the missions that did not succeed."""
    killed, missions, harmed = 0, 0, 0
    while killed < given.kills:
        task = service.client.post("/v1/missions", {"file": "inspect"})
        missions += 1
        while service.client.get(f"/v1/tasks/{task['id']}")["state"] not in FINAL:
            pid = service.console_pid()
            if pid is not None and killed < given.kills:
                os.kill(pid, signal.SIGKILL)
                killed += 1
            time.sleep(1.0)
        harmed += service.client.get(f"/v1/tasks/{task['id']}")["state"] != "succeeded"
    yield _at_most(f"missions harmed by {killed} kills of the console beside {missions} missions", harmed, 0, "")


def _at_least(what: str, value: float, least: float, unit: str) -> Line:
    told = f"{value:.2f} {unit}".rstrip()
    return Line(what=what, measured=told, wanted=f"{least:g} {unit}".rstrip(), is_met=value >= least)


def _at_most(what: str, value: float, most: float, unit: str) -> Line:
    digits = 2 if unit == "s" else 0 if not unit else 1
    told = f"{value:.{digits}f} {unit}".rstrip()
    return Line(what=what, measured=told, wanted=f"{most:g} {unit}".rstrip(), is_met=value <= most)


def _timers(service: Served) -> Array:
    """Return how many timers of the service's event loop were more than 10 ms late since its start, and how many there were."""
    text = service.client.fetch("GET", "/metrics").decode()
    found = dict(re.findall(r'event_loop_lag_seconds_bucket\{le="([^"]+)"\} (\S+)', text))
    every = float(found["+Inf"])
    return np.array([every - float(found["0.01"]), every])


def _stop(service: Served) -> float:
    """Return the time from a stop to the set latch, s, which the control thread reads at its next tick; reset it."""
    host, port = re.findall(r"//([^:/]+):(\d+)", service.stop_url)[0]
    with socket.create_connection((host, int(port))) as link:
        begun_s = time.perf_counter()
        link.sendall(b"POST /v1/stop HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        while not service.latch.is_set():
            if time.perf_counter() - begun_s > LONGEST_S:
                raise TimeoutError("the stop was not latched")
        taken_s = time.perf_counter() - begun_s
        while link.recv(4096):  # the answer comes when the stop is recorded
            pass
    state = service.client.get("/v1/stop")
    service.client.post("/v1/stop/reset", {"seen_count": state["count"]})
    return taken_s


PARTS: dict[str, Callable[[Served, Browser, argparse.Namespace], Iterator[Line]]] = {
    "latency": latency,
    "crowd": crowd,
    "scene": scene,
    "paint": paint,
    "axe": axe,
    "clicks": clicks,
    "kills": kills,
}

if __name__ == "__main__":
    raise SystemExit(main())
