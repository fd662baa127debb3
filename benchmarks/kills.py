"""Kills the processes of a cell in missions, and tears journals: `python -m benchmarks.kills [--share 0.1] [--seed 1]`.

Each role (service, cell, world, stop) is killed with SIGKILL at a random moment of a mission; `service.chaos` judges every round.
Then 1000 journals are cut at a random byte, as a power cut may leave what was not flushed: every row that was whole before that
byte is there, the chain is whole, and a service opens it. Prints tables and pass lines; the exit code is 1 if one is missed.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.config import load_cell
from service.chaos.options import ChaosOptions, Round
from service.chaos.plant import Plant, serve_command
from service.chaos.run import Chaos
from service.errors import JournalError
from service.tasks.journal import Journal
from service.tasks.journal_reader import read_records, verify_chain

ROOT = Path(__file__).resolve().parents[1]
TIMES = {"service": 200, "cell": 100, "world": 100, "stop": 50}
TORN = 1000
BACK_S = 5.0
ROWS = 40
ALL_ROWS = 10**6


@dataclass(frozen=True, slots=True, kw_only=True)
class Torn:
    """What journals had that were cut at a random byte.

    Attributes:
        lost: rows that were whole before the cut and are gone.
        called_broken: journals that end with a whole row, and whose chain is said to be broken (one without rows has no end).
        unreadable: journals with whole rows that no service can open.
    """

    cut: int
    lost: int
    called_broken: int
    unreadable: int


def main(arguments: Sequence[str] | None = None) -> int:
    """Kill, tear, print; return 1 if a pass line is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--share", type=float, default=1.0, help="share of the kills and cuts of the full run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cell", type=Path, default=ROOT / "cells/bench.toml")
    parser.add_argument("--only", default="", help="one role, or `torn`")
    given = parser.parse_args(arguments)
    print(f"seed {given.seed}, load {os.getloadavg()[0]:.1f}")
    print(
        "| killed | times | acks lost | self-made motions | other breaches | back s, median | p90 | longest | CPU load |"
    )
    print(f"|{' --- |' * 9}", flush=True)
    breaches: list[str] = []
    latest_s = 0.0
    for role, times in TIMES.items():
        if given.only in ("", role):
            rounds = killed(role, max(1, round(given.share * times)), seed=given.seed, cell=given.cell)
            breaches += [f"{role}, round {one.number}: {breach}" for one in rounds for breach in one.breaches]
            latest_s = max(latest_s, _print(role, rounds))
    torn = (
        tear(max(1, round(given.share * TORN)), seed=given.seed)
        if given.only in ("", "torn")
        else Torn(cut=0, lost=0, called_broken=0, unreadable=0)
    )
    print("\n".join(breaches))
    print(
        f"kills: {len(breaches)} breaches (pass: 0), back after {latest_s:.1f} s at the latest (pass: {BACK_S:.0f} s)"
    )
    print(
        f"torn journals: {torn.cut} cut; whole rows lost: {torn.lost}, whole journals that are called broken:"
        f" {torn.called_broken}, journals that a service cannot open: {torn.unreadable} (pass: 0, 0, 0)"
    )
    return int(bool(breaches) or latest_s > BACK_S or torn.lost + torn.called_broken + torn.unreadable > 0)


def killed(role: str, times: int, *, seed: int, cell: Path) -> list[Round]:
    """Kill one role in missions; returns the rounds, and as the last one what the end of the run shows."""
    with tempfile.TemporaryDirectory(prefix="panelwright-kills-") as folder:
        return chaos_rounds((f"kill {role}",), times, seed=seed, cell=cell, folder=Path(folder))


def chaos_rounds(faults: tuple[str, ...], times: int, *, seed: int, cell: Path, folder: Path) -> list[Round]:
    """Run chaos with some faults only; returns the rounds, and as the last one what the end of the run shows."""
    plant = Plant(command=serve_command(cell, None), runs=folder / "runs")
    chaos = chaos_on(plant, cell, ChaosOptions(seed=seed, rounds=times, faults=faults))
    return all_rounds(chaos)


def chaos_on(plant: Plant, cell: Path, options: ChaosOptions) -> Chaos:
    """Return a run of chaos with the devices of a cell file."""
    kinds = {name: section.kind.value for name, section in load_cell(cell).file.devices.items()}
    arm = next(name for name, kind in kinds.items() if kind == "arm")
    return Chaos(plant, options, arm=arm, devices=tuple(kinds))


def all_rounds(chaos: Chaos) -> list[Round]:
    """Run all rounds and print each; returns them, and as the last one what the end of the run shows."""
    rounds = list(chaos.rounds(lambda one: print(f"  {one}", file=sys.stderr, flush=True)))
    return [*rounds, chaos.final]


def _print(role: str, rounds: Sequence[Round]) -> float:
    """Print the row of a role; returns the longest time until it was back."""
    told = [breach for one in rounds for breach in one.breaches]
    lost = sum(breach.startswith("ack lost") for breach in told)
    moved = sum("moved by" in breach or "nobody asked for" in breach for breach in told)
    back = np.array([(one.followed_s or 0.0) + one.back_s for one in rounds if one.back_s is not None] or [np.nan])
    figures = " | ".join(f"{x:.1f}" for x in (np.median(back), np.quantile(back, 0.9), back.max()))
    print(
        f"| {role} | {len(rounds) - 1} | {lost} | {moved} | {len(told) - lost - moved} | {figures} | {os.getloadavg()[0]:.1f} |",
        flush=True,
    )
    return float(back.max())


def tear(times: int, *, seed: int) -> Torn:
    """Cut the write-ahead log of a journal at random bytes, behind and before rows that were acknowledged."""
    draw = random.Random(seed)
    lost = called_broken = unreadable = 0
    with tempfile.TemporaryDirectory(prefix="panelwright-torn-") as name:
        folder = Path(name)
        sizes = _written(folder / "whole")
        for number in range(times):
            copy = folder / "torn"
            shutil.copytree(folder / "whole", copy)
            log = copy / "journal.sqlite-wal"
            cut = draw.randrange(log.stat().st_size + 1)
            with log.open("r+b") as file:
                file.truncate(cut)
                if number % 2 and cut > 16:  # the last sector may hold anything
                    file.seek(cut - draw.randrange(1, 16))
                    file.write(draw.randbytes(4))
            on_disk = sum(size <= cut - 16 for size in sizes)
            wrong = _judged(copy / "journal.sqlite", on_disk)
            lost, called_broken, unreadable = lost + wrong[0], called_broken + wrong[1], unreadable + wrong[2]
            shutil.rmtree(copy)
    return Torn(cut=times, lost=lost, called_broken=called_broken, unreadable=unreadable)


def _written(folder: Path) -> list[int]:
    """Write rows one by one and keep the files as they are; returns the length of the log when each was acknowledged."""
    folder.mkdir()
    source = folder.with_name("source")
    source.mkdir()
    journal = Journal(source / "journal.sqlite")
    sizes = []
    for number in range(ROWS):
        journal.append("row", {"number": number, "text": "x" * (number * 37 % 900)})
        sizes.append((source / "journal.sqlite-wal").stat().st_size)
    for file in source.iterdir():  # as they are while the service runs, before anything is written back
        shutil.copy(file, folder / file.name)
    journal.close()
    (folder / "journal.sqlite-shm").unlink(missing_ok=True)
    return sizes


def _judged(path: Path, on_disk: int) -> tuple[int, int, int]:
    """Return the rows lost of those that were on disk, and 1 if a whole journal is called broken, and 1 if none can open it."""
    try:
        rows = len(read_records(path, limit=ALL_ROWS))
        try:
            verify_chain(path)
            is_whole = True
        except JournalError:
            is_whole = False
        journal = Journal(path)
        journal.append("after", {})
        journal.close()
    except (JournalError, sqlite3.Error) as error:
        print(f"  {error}", file=sys.stderr)
        return 0, 0, int(on_disk > 0)
    return max(0, on_disk - rows), int(not is_whole and rows > 0), 0


if __name__ == "__main__":
    raise SystemExit(main())
