"""The site file: one TOML file that lists the cells of a site."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hal.panel.turn import meant_otherwise
from hal.strict import Strict, load_toml

CellName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_-]{0,40}$", description="name of the cell within the site")]


class CellEntry(Strict):
    """`[[cells]]`: a cell of the site.

    Attributes:
        key_file, ca: an observer's key and the certificate to trust, by paths relative to the site file.
    """

    name: CellName
    url: Annotated[str, Field(pattern=r"^https?://[^\s]+$", max_length=300, description="address of its API")]
    key_file: Annotated[str | None, Field(description="file with an observer's key, for a service that has keys")] = (
        None
    )
    ca: Annotated[str | None, Field(description="file with the certificate to trust, for an https address")] = None


class SiteFile(Strict):
    """A site."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    name: Annotated[str, Field(min_length=1, max_length=80)] = "site"
    timeout_s: Annotated[float, Field(gt=0.0, le=60.0, description="longest wait for one answer of a cell")] = 3.0
    cells: Annotated[tuple[CellEntry, ...], Field(min_length=1, max_length=500)]

    @model_validator(mode="after")
    def _names_are_different(self) -> SiteFile:
        names = [one.name for one in self.cells]
        repeated = sorted({name for name in names if names.count(name) > 1})
        if repeated:
            raise meant_otherwise(f"several cells are called {', '.join(repeated)}", "give each cell its own name")
        return self


def load_site(path: Path) -> SiteFile:
    """Read a site file.

    Raises:
        ConfigError: names every fault with its key.
    """
    return load_toml(path, SiteFile, "site file")
