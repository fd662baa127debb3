"""Sections of the cell file about what outlives a mission: the history of readings."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from hal.strict import Strict


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
