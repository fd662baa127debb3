"""The times of a cron expression in a time zone, over both clock changes of a year."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import takewhile
from zoneinfo import ZoneInfo

from cronsim import CronSim


def times_after(cron: str, zone: str, after_s: float) -> Iterator[float]:
    """Yield the times of a cron expression that come after a moment, rising, in seconds since 1970.

    As in Debian's cron, a run at a fixed time that a clock change skips comes right after the change, and one that the change
    repeats comes once; an expression whose minute or hour is `*` goes by the time that really passes.

    Where clocks change by half an hour (Lord Howe Island), an expression such as `5 */2 * * *` may leave out one run that day.

    Source: cronsim, whose start is a local time, and which may therefore begin up to one clock change too early.
    """
    newest_s = after_s
    for moment in CronSim(cron, datetime.fromtimestamp(after_s, UTC).astimezone(ZoneInfo(zone))):
        due_s = moment.astimezone(UTC).timestamp()
        if due_s > newest_s:
            newest_s = due_s
            yield due_s


def times_between(cron: str, zone: str, after_s: float, until_s: float) -> list[float]:
    """Return the times after one moment, up to and including another."""
    return list(takewhile(lambda due_s: due_s <= until_s, times_after(cron, zone, after_s)))
