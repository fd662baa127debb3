"""The command line: `panelwright serve | demo | doctor | devices | task | stop | …`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import typer


def main() -> None:
    """Run the command line; a known error ends with one message and exit code 2, not with a traceback."""
    if sys.version_info[:2] != (3, 11):  # before any import that would fail with a less clear error
        found = f"{sys.version_info[0]}.{sys.version_info[1]}"
        sys.stderr.write(
            f"panelwright needs Python 3.11, this is {found}\n"
            "  try    install it with Python 3.11 (`make setup` in a checkout)\n"
        )
        raise SystemExit(2)
    os.environ["PYTHONSAFEPATH"] = "1"  # no child process imports a `drivers.py` of the current folder
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # our own errors report these faults, with a remedy
    from hal.errors import REINSTALL, CellError
    from service.commands.shutdown import leave
    from service.errors import of_file

    try:
        _app()()
    except CellError as error:
        sys.stderr.write(error.for_people() + "\n")
        leave(2)
    except OSError as error:  # missing folder, missing permission or full disk
        known = of_file(error)
        if known is None:
            raise
        sys.stderr.write(known.for_people() + "\n")
        leave(2)
    except KeyboardInterrupt:
        raise SystemExit(130) from None
    except ModuleNotFoundError as error:
        sys.stderr.write(f"the Python package {error.name!r} is not installed\n  try    {REINSTALL}\n")
        raise SystemExit(2) from None


def _app() -> Callable[[], None]:
    import typer

    from service.commands import init, serve, sweep, tasks
    from service.commands.backup import backup, restore
    from service.commands.certify import certify
    from service.commands.chaos import chaos
    from service.commands.check import check
    from service.commands.demo import demo
    from service.commands.develop import conform, emulate, new_driver
    from service.commands.doctor import doctor
    from service.commands.drivers import drivers
    from service.commands.foxglove import foxglove
    from service.commands.history import history
    from service.commands.journal import journal
    from service.commands.learn import learn
    from service.commands.objects import inspect, set_object
    from service.commands.range import batch, range_image
    from service.commands.read import read
    from service.commands.record import record, replay
    from service.commands.report import report
    from service.commands.teach import teach
    from service.commands.version import root
    from service.commands.warm import warm

    app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)
    app.callback()(root)
    app.add_typer(init.app)  # without a name of its own, so it is one command
    app.add_typer(serve.app)  # as `init`
    app.add_typer(sweep.app)
    plain: list[Callable[..., None]] = [demo, record, replay, certify, chaos, foxglove, doctor, check, drivers]
    plain += [tasks.stop, inspect, journal, history, report, backup, restore, conform, warm, teach, learn, read]
    for command in plain:
        app.command()(command)
    app.command("set")(set_object)
    app.command("range")(range_image)
    app.add_typer(batch, name="batch")
    app.command()(emulate)
    app.command("new-driver")(new_driver)
    _add_groups(app)
    return app


def _add_groups(app: typer.Typer) -> None:
    """Add the commands that have commands of their own."""
    from service.commands import alarms, calibrate, devices, keys, missions, panel, review, rounds, site, tasks

    groups = {
        "devices": devices.app,
        "task": tasks.app,
        "mission": missions.app,
        "panel": panel.app,
        "alarms": alarms.app,
        "rounds": rounds.app,
        "review": review.app,
        "site": site.app,
        "keys": keys.app,
        "calibrate": calibrate.app,
    }
    for name, group in groups.items():
        app.add_typer(group, name=name)


if __name__ == "__main__":
    main()
