"""Sections of the cell file about what outlives a mission: the history of readings, its review, and the rounds."""

from __future__ import annotations

from datetime import UTC, datetime
from difflib import get_close_matches
from typing import Annotated, Literal
from zoneinfo import ZoneInfo, available_timezones

from pydantic import Field, field_validator

from hal.panel.turn import meant_otherwise
from hal.strict import Strict

CRON_HINT = "minute 0-59, hour 0-23, day 1-31, month 1-12 and weekday 0-7 or MON-SUN, such as 0 6 * * MON-FRI"


class HistorySection(Strict):
    """`[history]`: how many readings and pictures are kept."""

    keep_days: Annotated[float, Field(gt=0, le=36_500, description="older readings leave the database")] = 400.0
    max_mb: Annotated[float, Field(ge=1, le=1e6, description="size from which the oldest readings leave it")] = 500.0
    crops_max_mb: Annotated[
        float, Field(ge=0, le=1e7, description="size of all pictures; the oldest are deleted; 0 keeps none")
    ] = 2_000.0
    parquet: Annotated[
        bool,
        Field(
            description="readings that leave the database go to Parquet files, which nothing deletes, instead of away"
        ),
    ] = False


class ReviewSection(Strict):
    """`[review]`: which readings a person is asked about."""

    sure_at: Annotated[
        float, Field(ge=0.5, le=1.0, description="least confidence of a reading that needs no person")
    ] = 0.8
    audit_share: Annotated[
        float, Field(ge=0.0, le=1.0, description="share of the sure readings that a person is asked about all the same")
    ] = 0.0
    certificate: Annotated[
        str | None, Field(description="file that `panelwright certify` has written, in the cell file's folder or above")
    ] = None


class RoundSection(Strict):
    """`[[rounds]]`: a mission that the service runs by itself, at times that a cron expression states."""

    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
    mission: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,60}$", description="name of a mission file")] = "inspect"
    cron: Annotated[
        str,
        Field(
            max_length=200, description="minute, hour, day of the month, month, day of the week, as in Debian's cron"
        ),
    ]
    zone: Annotated[str, Field(max_length=60, description="IANA time zone of `cron`, such as Europe/Vienna")] = "UTC"
    window_s: Annotated[
        float, Field(ge=60, le=604_800, description="a run that could not begin in time may begin this much later")
    ] = 3600.0
    missed: Annotated[
        Literal["late", "skip"],
        Field(description="after the window: `late` runs the newest missed run as soon as it may, `skip` none"),
    ] = "skip"
    forbidden_by: Annotated[
        tuple[str, ...],
        Field(max_length=50, description="alarms that keep it from beginning while their condition holds"),
    ] = ()

    @field_validator("cron")
    @classmethod
    def _is_cron(cls, text: str) -> str:
        from cronsim import CronSim, CronSimError  # only cells with rounds need it

        if len(text.split()) != 5:
            raise meant_otherwise(f"{text!r} has {len(text.split())} fields instead of 5", CRON_HINT)
        try:
            next(CronSim(text, datetime.now(UTC)))
        except StopIteration:
            raise meant_otherwise(f"{text!r} names no day that ever comes", CRON_HINT) from None
        except (CronSimError, ValueError) as error:
            why = str(error).removeprefix("Bad ")
            raise meant_otherwise(f"{text!r} is no cron expression: its {why} cannot be meant", CRON_HINT) from None
        return text

    @field_validator("zone")
    @classmethod
    def _is_zone(cls, name: str) -> str:
        try:
            ZoneInfo(name)
        except (LookupError, ValueError, OSError):
            near = get_close_matches(name, available_timezones(), n=1)
            hint = f"did you mean {near[0]!r}?" if near else "write for example Europe/Vienna"
            raise meant_otherwise(f"{name!r} is no IANA time zone", hint) from None
        return name
