"""Attacks every route with bad input: `python -m benchmarks.bad_input --generated 60 --raw 200 --seed 1`.

It serves the simulated bench cell with the stop latched, so that not even a valid request may move the arm. Each operation of
the API document gets requests that schemathesis generates, and raw bodies: the corpus below and random changes of it. No answer
may be a 5xx other than a declared 502, 503 or 504, a refusal must be short, and no joint may move. The exit code is 1 otherwise.
"""

from __future__ import annotations

import argparse
import collections
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.fuzz_parsers import case_of
from hal.config import load_cell
from service.serve import Options, Panelwright

ROOT = Path(__file__).parents[1]
DECLARED = (502, 503, 504)
SKIPPED = {"/v1/stop/reset", "/v1/tasks/{task_id}/events", "/v1/feed/events"}  # would free the arm; streams
LONGEST_S = 20.0
CORPUS: tuple[bytes, ...] = (
    b"{}", b"[]", b"5", b"null", b"{", b"{}{}", b'{"a": NaN}', b'{"a": 1e400}', b'{"a": "\\ud800"}', b'{"a": "\xff\xfe"}',
    b'{"a": 1, "a": 2}', b"{'a': 1}", b'{"a": 1,}', b"[" * 50_000, b'{"a":' * 20_000, b'{"a": ' + b"9" * 9_000 + b"}",
    b'{"objects": ["x"], "mode": "blind"}', b'{"driver": "files:camera", "options": {"folder": "/etc"}}',
    b'{"holder": "a"}', b'{"fault": "silent", "magnitude": 1e308}', "{}".encode("utf-16"), b"\0", b"\x89PNG\r\n\x1a\n" + bytes(40),
)  # fmt: skip


class Tally:
    """Counts answers by status class, and keeps those that break a promise."""

    def __init__(self) -> None:
        self.statuses: collections.Counter[str] = collections.Counter()
        self.breaches: list[str] = []

    def note(self, what: str, status: int, size: int) -> None:
        """Count one answer."""
        self.statuses[f"{status // 100}xx"] += 1
        if status >= 500 and status not in DECLARED:
            self.breaches.append(f"{what}: {status}")
        if status in (400, 413, 415, 422) and size > 8000:
            self.breaches.append(f"{what}: {size} bytes of refusal")


def operations(document: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield method and path of all operations."""
    for path, methods in document["paths"].items():
        if path not in SKIPPED:
            yield from ((method.upper(), path) for method in methods)


def raw(http: httpx2.Client, document: dict[str, Any], tally: Tally, *, cases: int, draw: random.Random) -> None:
    """Send raw bodies, right and wrong types and odd queries to every operation."""
    for method, path in operations(document):
        for number in range(cases):
            body = CORPUS[number] if number < len(CORPUS) else b"".join(case_of(draw, CORPUS))
            media = (
                "application/json"
                if number % 5
                else draw.choice(["text/plain", "image/png", "", "application/json; x"])
            )
            address = path.replace("{", "").replace("}", "") if number % 2 else path.replace("{name}", "arm")
            query = "" if number % 7 else f"?wait_s={draw.choice(['nan', '-1', '1e400', 'x', '0'])}&odd={number}"
            headers = [(b"Content-Type", media.encode()), (b"Lease-Token", draw.choice([b"", b"1.x", b"\xc3\xa9"]))]
            try:
                answer = http.request(method, address + query, content=body, headers=headers)
            except httpx2.TransportError as error:
                tally.breaches.append(f"{method} {path}: {type(error).__name__} for {body[:60]!r}")
                continue
            tally.note(f"{method} {path} {body[:60]!r}", answer.status_code, len(answer.content))


def generated(url: str, document: dict[str, Any], tally: Tally, *, cases: int, seed: int) -> None:
    """Send what schemathesis generates from the API document, valid and not."""
    import schemathesis
    from hypothesis import HealthCheck, given, settings
    from hypothesis import seed as seeded
    from schemathesis.generation import GenerationMode

    schema = schemathesis.openapi.from_dict(document)
    schema.config.update(base_url=url)
    results: Any = schema.get_all_operations()
    for result in results:
        operation = result.ok()
        if operation.path in SKIPPED:
            continue
        for mode in (GenerationMode.POSITIVE, GenerationMode.NEGATIVE):

            @seeded(seed)
            @settings(max_examples=cases // 2, deadline=None, suppress_health_check=list(HealthCheck), database=None)
            @given(case=operation.as_strategy(generation_mode=mode))
            def attack(case: Any) -> None:
                for name in ("wait_s",):
                    if case.query:
                        case.query.pop(name, None)  # otherwise each request would wait for 30 s
                answer = case.call(headers={"Connection": "close"}, timeout=LONGEST_S)
                tally.note(f"{case.method} {case.path}", answer.status_code, len(answer.content))

            try:
                attack()
            except (
                Exception
            ) as error:  # no data can be generated for some operations: a GET without parameters has no bad one
                if "Unsatisfiable" not in type(error).__name__ and "cannot" not in str(error).lower():
                    tally.breaches.append(
                        f"{operation.method} {operation.path}: {type(error).__name__}: {str(error)[:200]}"
                    )


def main() -> None:
    """Attack, and print what came back."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--generated", type=int, default=60, help="generated requests to each operation")
    options.add_argument("--raw", type=int, default=200, help="raw requests to each operation")
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    tally = Tally()
    with tempfile.TemporaryDirectory() as folder:
        cell = load_cell(ROOT / "cells" / "bench.toml")
        panelwright = Panelwright(cell, Options(port=0, runs_dir=Path(folder) / "runs", inline=True, warm=False))
        panelwright.start()
        try:
            panelwright.service.supervisor.stop("the benchmark")
            mover = panelwright.service.supervisor.connection.mover
            before = mover.state().position_rad.copy()
            with httpx2.Client(base_url=panelwright.url, timeout=LONGEST_S, trust_env=False) as http:
                document = http.get("/openapi.json").json()
                begun_s = time.perf_counter()
                raw(http, document, tally, cases=given.raw, draw=random.Random(given.seed))
                generated(panelwright.url, document, tally, cases=given.generated, seed=given.seed)
                taken_s = time.perf_counter() - begun_s
            moved_rad = float(abs(mover.state().position_rad - before).max())
            counted = sum(tally.statuses.values())
            told = ", ".join(f"{count} {status}" for status, count in sorted(tally.statuses.items()))
            print(f"{len(list(operations(document)))} operations, {counted} answers in {taken_s:.0f} s: {told}")
            print(
                f"largest motion of a joint: {1e3 * moved_rad:.1f} mrad; latched: {panelwright.service.supervisor.latch.is_set()}"
            )
        finally:
            panelwright.close()
    for what, times in collections.Counter(tally.breaches).most_common(40):
        print(f"{times} x {what}")
    sys.exit(1 if tally.breaches or moved_rad > 0.003 else 0)


if __name__ == "__main__":
    main()
