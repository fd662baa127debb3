"""`panelwright record` and `panelwright replay`: a mission with everything that its devices said, and the same again."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from service.client import Client
from service.commands.common import DEFAULT_CELL, CellOption, SeedOption, console, read_cell
from service.commands.own_cell import run_task
from service.commands.serve import run_to_end
from service.commands.shutdown import INTERRUPTED, leave, one_interrupt
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from service.recording.reader import Recording
    from service.replay.book import Book
    from service.replay.verdict import Verdict
    from service.tasks.model import Task

SHOWN = 5  # differences
RecordingFile = Annotated[Path, typer.Argument(metavar="FILE", help="Recording (MCAP).")]
Runs = Annotated[Path, typer.Option(help="Folder for reports, journal and artefacts.")]


def record(
    file: RecordingFile,
    *,
    cell: CellOption = DEFAULT_CELL,
    seed: SeedOption = None,
    task: Annotated[str, typer.Option(help="Verb of the task to run, with its usual request.")] = "missions",
    runs: Runs = Path("runs"),
) -> None:
    """Start a cell, run a whole mission on it, and record everything that its devices are asked and answer.

    The exit code is 0 when the task succeeded and was recorded to its end; the recording is kept either way. To record
    until Ctrl-C whatever clients do, use `panelwright serve --record FILE`. For the traffic of one device, see
    `panelwright devices record`.
    """
    from service.serve import Options, Panelwright, exit_on_sigterm

    loaded = read_cell(cell, seed)
    compile_first()
    exit_on_sigterm()
    panelwright = Panelwright(loaded, Options(port=0, runs_dir=runs, record=file))
    console.print(f"cell [bold]{loaded.name}[/], seed {loaded.file.cell.seed}: starting")
    code = 1
    with one_interrupt():
        try:
            panelwright.start()
            code = 0 if _recorded_task(panelwright.client(), task) else 1
        except KeyboardInterrupt:
            console.print("Ctrl-C: stopping the arm and ending the recording")
            code = INTERRUPTED
        finally:
            panelwright.close()
        console.print(f"[bold]{file}[/]: {contents(file)}")
        recording = panelwright.service.recording
        if recording is not None and recording.problem:
            console.print(f"[red]the recording ended early[/]: {escape(recording.problem)}")
            code = code or 1
        console.print(f"play it back: panelwright replay {file}   look at it: open it in Foxglove")
        leave(code)


def _recorded_task(client: Client, verb: str) -> bool:
    stop = client.get("/v1/stop")
    if stop["is_latched"]:  # as in `demo`, whoever runs it states that the cell is clear
        client.post("/v1/stop/reset", {"seen_count": stop["count"]})
    return bool(run_task(client, f"/v1/{verb}", {"file": "demo"} if verb == "missions" else {})["state"] == "succeeded")


def contents(file: Path) -> str:
    """Return size, duration and number of messages of a finished recording, in words."""
    from service.recording.reader import numbers_of

    duration_s, messages = numbers_of(file)
    return f"{1e-6 * file.stat().st_size:.1f} MB, {duration_s:.1f} s, {messages} messages"


def replay(
    file: RecordingFile,
    *,
    serve: Annotated[
        bool, typer.Option("--serve", help="Serve the recorded cell over HTTP instead of running its tasks.")
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65534, help="HTTP port for --serve; 0 takes a free one.")] = 8460,
    runs: Annotated[
        Path | None, typer.Option(help="Folder for the reports of the replay; by default they are not kept.")
    ] = None,
) -> None:
    """Run the tasks of a recording again, with the recorded answers in place of the devices, and compare the results.

    The exit code is 0 when all calls of the devices and all results are equal to the last bit, 1 when they differ.
    Nothing is connected and nothing moves.
    """
    from service.recording.reader import open_recording
    from service.replay.book import Book

    console.print(f"reading {file}")
    recording = open_recording(file)
    console.print(told(recording))
    compile_first()
    with tempfile.TemporaryDirectory(prefix="panelwright-replay-") as folder:
        code = _replayed(Book(recording), Path(folder), runs, port if serve else None)
    leave(code)


def _replayed(book: Book, folder: Path, runs: Path | None, port: int | None) -> int:
    """Serve the recorded cell on `port`, or run its tasks; returns the exit code."""
    from service.core import Service
    from service.operations import OPERATIONS
    from service.replay.book import replayed_cell
    from service.replay.verdict import replay_tasks
    from service.serve import Options, Panelwright

    cell = book.recording.unpack(folder / "cell")
    runs_dir = runs or folder / "runs"
    if port is not None:
        options = Options(
            port=port, runs_dir=runs_dir, inline=True, warm=False, replay=lambda: replayed_cell(book, cell)
        )
        console.print(f"the recorded cell answers on port {port}; Ctrl-C ends it")
        run_to_end(Panelwright(cell, options))
    service = Service(cell, OPERATIONS, runs_dir=runs_dir, inline=True, replay=lambda: replayed_cell(book, cell))
    verdicts = []
    with one_interrupt():
        try:
            service.start()
            service.tasks.subscribe(_Steps().show)
            for verdict in replay_tasks(service, book, begin=lambda task: console.print(f"replaying {task.verb}")):
                verdicts.append(verdict)
                show(verdict)
        except KeyboardInterrupt:
            return INTERRUPTED
        finally:
            service.close()
    return 0 if verdicts and all(verdict.same_bits for verdict in verdicts) else 1


class _Steps:
    """Prints the steps of tasks as they come."""

    def __init__(self) -> None:
        self._newest = ""

    def show(self, task: Task) -> None:
        """Print the task's step, if it is new."""
        if task.step and task.step != self._newest:
            self._newest = task.step
            console.print(f"  {100 * task.fraction:3.0f} %  {escape(task.step)}")


def told(recording: Recording) -> str:
    """Return what a recording holds, in words."""
    about: dict[str, Any] = recording.about
    made = f"cell {about.get('cell')}, {about.get('mode')}, seed {about.get('seed')}, panelwright {about.get('panelwright')}"
    tasks = ", ".join(f"{task.verb} ({task.state or 'no end'})" for task in recording.tasks) or "no tasks"
    cut = (
        f"\n  it was cut off at {recording.end_s:.3f} s of the cell; what stands before is complete"
        if recording.is_cut
        else ""
    )
    return f"{made}: {tasks}{cut}"


def show(verdict: Verdict) -> None:
    """Print how a replayed task compares with its recording."""
    answered = f"{verdict.answered} of {verdict.calls} recorded calls"
    if verdict.same_bits:
        result = "as far as the recording goes" if verdict.note else "and the result"
        console.print(f"{verdict.verb}: [green]same to the last bit[/]: {answered}, {result}")
    elif verdict.same_readings:
        console.print(f"{verdict.verb}: [yellow]same readings[/]: {answered}; but not the same result")
    else:
        console.print(f"{verdict.verb}: [red]not the same[/]: {answered} asked for again")
    for difference in verdict.differences[:SHOWN]:
        console.print(f"  differs  {escape(difference)}")
    if len(verdict.differences) > SHOWN:
        console.print(f"  and {len(verdict.differences) - SHOWN} more")
    for word, text in (("cause", verdict.complaint), ("try", verdict.hint), ("note", verdict.note)):
        if text:
            console.print(f"  {word:<8} {escape(text)}")
