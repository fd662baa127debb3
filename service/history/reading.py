"""One reading as the history keeps it, and how it is made from what a look has given."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from perception.vision import ObjectReading

VALID, INVALID = "valid", "invalid"
AUDIT = "a sure one, drawn for an audit"
ABSENT = "it is not where the panel file says"


@dataclass(frozen=True, slots=True, kw_only=True)
class StoredReading:
    """A reading of one object with its circumstances.

    Attributes:
        object, kind: of the panel file.
        utc_s: time of the reading in seconds since 1970; `cell_s` is the same on the cell's clock.
        quality: `valid`, or `invalid` for a reading that was refused or an object that was not found.
        cause: why it is invalid, as a sentence; empty for a valid one.
        value, unit, sigma: the number with its unit and standard deviation; None where the object shows none.
        state, text: what the object shows in words or digits.
        confidence: expected share of correct answers among such readings.
        guess: what an invalid reading withholds, and its rivals, as JSON; None if nothing is known.
        verb, task, mission: what took it; `mission` is empty outside of missions.
        asked_by: the key, else the holder of the lease, that asked for it; empty without both.
        phase: the part of the work at which it was taken, such as `before the actions`.
        told: what the object was last told to be; None if it never was.
        crop: SHA-256 of the picture of the object; None if there is none.
        doubt: why a person should look at it, as a sentence; empty for a sure one that was not drawn for an audit.
        certificate: what judged cases say about it, as JSON; None if nobody asked for that.
        answered: what a person has said about it, as JSON; None as long as nobody has.
        final_value, final_state, final_text: what it shows by that answer; all None if that could not be told.
    """

    object: str
    kind: str
    utc_s: float
    cell_s: float
    quality: str
    cause: str = ""
    value: float | None = None
    unit: str = ""
    sigma: float | None = None
    state: str | None = None
    text: str | None = None
    confidence: float = 0.0
    guess: str | None = None
    verb: str = ""
    task: str = ""
    mission: str = ""
    asked_by: str = ""
    phase: str = ""
    told: str | None = None
    crop: str | None = None
    doubt: str = ""
    certificate: str | None = None
    answered: str | None = None
    final_value: float | None = None
    final_state: str | None = None
    final_text: str | None = None

    @property
    def is_valid(self) -> bool:
        """Whether the reading was given and not refused."""
        return self.quality == VALID

    @property
    def is_sure(self) -> bool:
        """Whether it was given, and nothing speaks against it."""
        return self.is_valid and self.doubt in ("", AUDIT)


COLUMNS = tuple(field.name for field in fields(StoredReading))


def answer_of(reading: ObjectReading) -> dict[str, Any]:
    """Return the fields of a stored reading that come from the look itself."""
    is_valid = reading.answered
    return {
        "object": reading.name,
        "kind": reading.kind,
        "quality": VALID if is_valid else INVALID,
        "cause": "" if is_valid else (reading.reason or ABSENT),
        "value": reading.value if is_valid else None,
        "unit": reading.unit,
        "sigma": reading.uncertainty if is_valid else None,
        "state": reading.state if is_valid else None,
        "text": reading.text if is_valid else None,
        "confidence": float(reading.confidence),
        "guess": None if is_valid else _guess(reading),
    }


def _guess(reading: ObjectReading) -> str | None:
    """Return the withheld reading and its rivals as JSON; None if there are none."""
    if reading.guess is None and not reading.possible:
        return None
    held = {} if reading.guess is None else {k: v for k, v in asdict(reading.guess).items() if v is not None}
    return json.dumps({"held": held, "possible": [asdict(one) for one in reading.possible]})
