"""Every option of every driver is described in words, and the example of a cell file is accepted."""

from __future__ import annotations

import tomllib
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import Field
from typer.testing import CliRunner

from hal.registry import device_factory, installed_drivers, options_model
from hal.strict import Strict, validate
from service.cli import _app
from service.commissioning.driver_options import describe, example_of, options_of


@pytest.mark.parametrize("driver", [name for name in installed_drivers() if not name.startswith("fake:")])
def test_each_option_is_described_and_the_example_is_accepted(driver: str) -> None:
    info = describe(driver)
    assert not [option.key for option in info.options if not option.description]
    (section,) = tomllib.loads(info.example)["devices"].values()
    assert (section["kind"], section["driver"]) == (info.kind, driver)
    model = options_model(device_factory(driver))
    assert model is not None
    validate(section.get("options", {}), model, source="example")


class Colour(StrEnum):
    """Choices."""

    RED = "red"


class Row(Strict):
    """Entry of a list."""

    a_m: Annotated[float, Field(gt=0, description="length")]


class Base(Strict):
    """Model whose descriptions are inherited."""

    rate_hz: Annotated[float, Field(ge=1, le=10, description="rate")] = 5.0
    place: str | Annotated[int, Field(ge=1, le=9)] = 3


class Options(Base):
    """Model with every sort of key."""

    rate_hz: float = 7.0
    points: Annotated[tuple[Annotated[int, Field(ge=0, lt=4)], ...], Field(description="points")] = (0, 1)
    mode: Literal["a", "b"] | None = None
    colour: Colour = Colour.RED
    path: Path
    is_on: bool = True
    rows: tuple[Row, ...]
    taught: Annotated[str, Field(examples=["by hand"])]


def test_types_units_defaults_and_ranges_are_words() -> None:
    rows = {o.key: (o.type, o.unit, o.default, o.range, o.description) for o in options_of(Options)}
    assert rows["rate_hz"] == ("number", "Hz", "7.0", "", "rate")
    assert rows["place"] == ("text or whole number", "", "3", "1 to 9", "")
    assert rows["points"] == ("list of whole numbers", "", "[0, 1]", "each ≥ 0 and < 4", "points")
    assert rows["mode"] == ("choice", "", "none", '"a", "b"', "")
    assert rows["colour"] == ("choice", "", '"red"', '"red"', "")
    assert rows["is_on"][2] == "true" and rows["path"][:3] == ("path", "", "must be given")
    assert rows["rows"][0] == "list of tables" and rows["rows[].a_m"] == (
        "number",
        "m",
        "must be given",
        "> 0",
        "length",
    )


def test_an_example_has_every_key_that_must_be_given() -> None:
    assert example_of(Options) == {"path": "recordings", "rows": [{"a_m": 1.0}], "taught": "by hand"}


def test_the_command_lists_drivers_and_shows_the_options_of_one() -> None:
    runner = CliRunner()
    listed = runner.invoke(_app(), ["drivers"])
    assert listed.exit_code == 0 and "serial:tfmini" in listed.output and "proximity" in listed.output
    shown = runner.invoke(_app(), ["drivers", "serial:tfmini"])
    assert "min_strength" in shown.output and 'driver = "serial:tfmini"' in shown.output
    wrong = runner.invoke(_app(), ["drivers", "serial:tfmimi"])
    assert wrong.exit_code != 0 and "serial:tfmini" in getattr(wrong.exception, "hint", "")
