"""The record of judged cases in a file, and what it says about a reading."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from hal.atomic_write import write_atomically
from hal.errors import ConfigError
from hal.strict import Strict
from service.certificate.bound import ASSURANCE, by_cluster, wrong_at_most
from service.certificate.regime import Features, box_of, features_of, outside

Share = Annotated[float, Field(ge=0, le=1)]


class KindRecord(Strict):
    """Judged sure readings of one kind: how many, in how many clusters, of which how many are wrong, and their regime."""

    cases: Annotated[int, Field(ge=1)]
    clusters: Annotated[int, Field(ge=1)]
    wrong: Annotated[int, Field(ge=0)]
    at_most: Share
    regime: dict[str, tuple[float, float]]


class CertificateFile(Strict):
    """A certificate: where its cases come from, and what they say about each kind."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    source: Literal["simulation", "site"]
    panel: str
    version: str
    made: str
    seeds: tuple[int, ...] = ()
    sure_at: Share
    assurance: Share = ASSURANCE
    kinds: dict[str, KindRecord]


@dataclass(frozen=True, slots=True, kw_only=True)
class Case:
    """A judged sure reading; `cluster` is the same for readings that are not independent, of one dial in one hour."""

    kind: str
    cluster: str
    is_wrong: bool
    features: Features


def kinds_of(cases: Iterable[Case]) -> dict[str, KindRecord]:
    """Return what judged cases say about each kind."""
    by_kind: dict[str, list[Case]] = {}
    for case in cases:
        by_kind.setdefault(case.kind, []).append(case)
    found: dict[str, KindRecord] = {}
    for kind, own in sorted(by_kind.items()):
        clusters, wrong = by_cluster((case.cluster, case.is_wrong) for case in own)
        found[kind] = KindRecord(
            cases=len(own),
            clusters=clusters,
            wrong=wrong,
            at_most=wrong_at_most(wrong, clusters),
            regime=box_of([case.features for case in own]),
        )
    return found


def write_certificate(certificate: CertificateFile, path: Path) -> None:
    """Write a certificate as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, certificate.model_dump_json(by_alias=True, indent=1) + "\n")


class Certificate:
    """Says for a reading what its certificate is, or why it has none.

    Args:
        path: the file; None: no reading has a certificate.
        panel, sure_at: of the cell; a file of another panel, or of a lower sure line, certifies nothing here.

    Raises:
        ConfigError: the file cannot be read.
    """

    def __init__(self, path: Path | None, *, panel: str, sure_at: float) -> None:
        self._file: CertificateFile | None = None
        self._none, self._id = "no certificate is named in the cell file", ""
        if path is None:
            return
        try:
            text = path.read_text(encoding="utf-8")
            self._file = CertificateFile.model_validate_json(text)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"the certificate {path} cannot be read: {error}", hint="`panelwright certify` writes one"
            ) from error
        self._id = hashlib.sha256(text.encode()).hexdigest()[:16]
        if self._file.panel != panel:
            self._none = f"the certificate is of the panel {self._file.panel!r}"
            self._file = None
        elif sure_at < self._file.sure_at:
            self._none = f"the certificate is of readings that are sure at {self._file.sure_at:g}"
            self._file = None

    def of(self, kind: str, crop: bytes | None, *, is_sure: bool) -> str:
        """Return as JSON `at_most`, `assurance`, `cases`, `wrong` and `id`, or `none` with the reason."""
        found = self._found(kind, crop, is_sure=is_sure)
        return json.dumps({"none": found} if isinstance(found, str) else dict(found))

    def _found(self, kind: str, crop: bytes | None, *, is_sure: bool) -> str | Mapping[str, object]:
        if not is_sure:
            return "it is not sure"
        if self._file is None:
            return self._none
        record = self._file.kinds.get(kind)
        if record is None:
            return f"no {kind} was judged"
        features = None if crop is None else features_of(crop)
        if features is None:
            return "it has no picture"
        differs = outside(record.regime, features)
        if differs:
            return differs
        return {
            "at_most": round(record.at_most, 6),
            "assurance": self._file.assurance,
            "cases": record.clusters,
            "wrong": record.wrong,
            "source": self._file.source,
            "id": self._id,
        }
