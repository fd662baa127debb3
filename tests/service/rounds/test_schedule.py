"""Tests of the schedule against a walk over every minute, over both clock changes of several zones."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import pytest

from hal.errors import ConfigError
from hal.plant import RoundSection
from hal.strict import validate
from service.rounds.schedule import times_after, times_between

CHANGES = {  # a day before a clock change, and its zone
    "Europe/Vienna": (datetime(2026, 3, 28, tzinfo=UTC), datetime(2026, 10, 24, tzinfo=UTC)),
    "America/New_York": (datetime(2026, 3, 7, tzinfo=UTC), datetime(2026, 10, 31, tzinfo=UTC)),
    "Australia/Sydney": (datetime(2026, 10, 3, tzinfo=UTC), datetime(2027, 4, 3, tzinfo=UTC)),
    "Australia/Lord_Howe": (datetime(2026, 10, 3, tzinfo=UTC), datetime(2027, 4, 3, tzinfo=UTC)),  # by half an hour
}


def fixed_times(hour: int, minute: int, zone: str, start: datetime, days: int) -> list[float]:
    """Return when each local day reaches a time: the first such minute, or the first one after a gap that skips it."""
    found: dict[object, float] = {}
    for step in range(1, 1440 * days + 1):
        moment = start + timedelta(minutes=step)
        local = moment.astimezone(ZoneInfo(zone))
        before = (moment - timedelta(minutes=1)).astimezone(ZoneInfo(zone))
        wanted = local.replace(hour=hour, minute=minute, fold=0, tzinfo=None)
        now, earlier = local.replace(tzinfo=None), before.replace(tzinfo=None)
        if earlier < wanted <= now:
            found.setdefault(local.date(), moment.timestamp())
    return sorted(found.values())


@pytest.mark.parametrize("zone", CHANGES)
@pytest.mark.parametrize(("hour", "minute"), [(1, 30), (2, 0), (2, 15), (3, 0)])
def test_a_fixed_time_comes_once_a_day_and_right_after_a_gap(zone: str, hour: int, minute: int) -> None:
    for start in CHANGES[zone]:
        end_s = (start + timedelta(days=3)).timestamp()
        found = times_between(f"{minute} {hour} * * *", zone, start.timestamp(), end_s)
        assert found == fixed_times(hour, minute, zone, start, 3)


@pytest.mark.parametrize("zone", CHANGES)
def test_every_quarter_of_an_hour_goes_by_the_time_that_really_passes(zone: str) -> None:
    for start in CHANGES[zone]:
        found = times_between("*/15 * * * *", zone, start.timestamp(), (start + timedelta(days=3)).timestamp())
        assert found == [start.timestamp() + 900.0 * k for k in range(1, 3 * 96 + 1)]


@pytest.mark.parametrize("cron", ["30 2 * * *", "0 2,3 * * *", "*/20 * * * *", "5 */2 * * *", "0 1 * * SUN"])
@pytest.mark.parametrize("zone", [zone for zone in CHANGES if zone != "Australia/Lord_Howe"])  # see `times_after`
def test_the_times_are_the_same_from_wherever_one_begins(cron: str, zone: str) -> None:
    """A service that restarts at any minute around the change sees the same times."""
    for start in CHANGES[zone]:
        start_s, end_s = start.timestamp(), start.timestamp() + 3 * 86_400.0
        known = times_between(cron, zone, start_s, end_s)
        for minute in range(0, 2 * 1440, 31):
            from_s = start_s + 60.0 * minute
            following = next(times_after(cron, zone, from_s))
            assert following == next((due_s for due_s in known if due_s > from_s), following)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"cron": "0 25 * * *"}, "'0 25 * * *' is no cron expression: its hour cannot be meant"),
        ({"cron": "0 0 6 * * *"}, "has 6 fields instead of 5"),
        ({"cron": "0 0 30 2 *"}, "is no cron expression"),
        ({"cron": "0 6 * * *", "zone": "Europe/Wien"}, "'Europe/Wien' is no IANA time zone"),
        ({"cron": "0 6 * * *", "zone": "../etc/passwd"}, "is no IANA time zone"),
    ],
)
def test_what_cannot_be_meant_is_refused(given: dict[str, str], told: str) -> None:
    with pytest.raises(ConfigError, match=told.replace("*", r"\*")):
        validate({"name": "morning", **given}, RoundSection, source="cell.toml")
