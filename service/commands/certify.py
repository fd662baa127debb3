"""`panelwright certify`: judges fresh readings in simulation, or the answers of people, and writes a certificate."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from hal.errors import InvalidRequest
from service.commands.common import DEFAULT_CELL, CellOption, Url, UrlDefault, client_of, console, find_cell
from service.commands.tasks import follow
from service.commands.warm import compile_first

if TYPE_CHECKING:
    from service.certificate.record import Case, CertificateFile
    from service.client import Client

HOUR_S = 3600.0
PAGE = 1000


def certify(
    *,
    cell: CellOption = DEFAULT_CELL,
    first: Annotated[
        int, typer.Option(min=0, max=2**31 - 1, help="First seed; take seeds that nobody has looked at.")
    ] = 1,
    cases: Annotated[int, typer.Option(min=1, help="Number of seeds, each with a simulated panel of its own.")] = 10,
    mission: Annotated[str, typer.Option(help="Mission file whose readings are judged.")] = "inspect",
    site: Annotated[
        bool, typer.Option("--site", help="Judge by the audits that people have answered at the service of --url.")
    ] = False,
    out: Annotated[Path, typer.Option(help="File of the certificate.")] = Path("runs/certificate.json"),
    url: Url = UrlDefault,
) -> None:
    """Judge sure readings and write how many are wrong at most, with 95 % assurance, for each kind of object."""
    from hal.config import load_cell
    from service.certificate.record import CertificateFile, kinds_of, write_certificate
    from service.http.health import own_version

    loaded = load_cell(find_cell(cell))
    seeds = () if site else tuple(range(first, first + cases))
    found = list(_answered(client_of(url)) if site else _simulated(find_cell(cell), seeds, mission))
    if not found:
        hint = "set review.audit_share in the cell file, and answer what waits" if site else "take other seeds"
        raise InvalidRequest("there is no judged reading with a picture", hint=hint)
    certificate = CertificateFile(
        source="site" if site else "simulation",
        panel=loaded.panel.name,
        version=own_version(),
        made=datetime.now(UTC).isoformat(timespec="seconds"),
        seeds=seeds,
        sure_at=loaded.file.review.sure_at,
        kinds=kinds_of(found),
    )
    write_certificate(certificate, out)
    console.print(_table(certificate))
    console.print(f"wrote {out}; name it in the cell file: [review] certificate = ...", markup=False)


def _simulated(path: Path, seeds: tuple[int, ...], mission: str) -> Iterator[Case]:
    """Yield the sure readings of a mission on the simulated cell of each seed, judged by the simulator's truth."""
    from hal.config import load_cell
    from service.serve import Options, Panelwright

    compile_first()
    for seed in seeds:
        with tempfile.TemporaryDirectory(prefix="panelwright-certify-") as folder:
            panelwright = Panelwright(load_cell(path, seed=seed), Options(port=0, runs_dir=Path(folder)))
            try:
                panelwright.start()
                client = panelwright.client()
                follow(client, client.post("/v1/missions", {"file": mission})["id"])
                yield from _judged(panelwright, client, seed)
            finally:
                panelwright.close()


def _judged(panelwright: Any, client: Client, seed: int) -> Iterator[Case]:
    from hal.panel import Shown
    from service.evaluate import shown_of, truth_of

    panel = panelwright.service.cell.panel
    truths = {one.name: one for one in truth_of(panelwright.service.supervisor.connection, 0.0).objects}
    for one in client.get("/v1/history")["newest"]:
        if one["sure"] and one["object"] in truths:
            said = Shown(value=one["value"], state=one["state"], text=one["text"])
            is_right = panel.object(one["object"]).is_right(said, shown_of(truths[one["object"]]))
            yield from _case(client, one, f"{seed} {one['object']}", is_wrong=not is_right)


def _answered(client: Client) -> Iterator[Case]:
    """Yield the sure readings that were drawn for an audit and that a person has answered."""
    from service.history.reading import AUDIT

    for name in [one["object"] for one in client.get("/v1/history")["newest"]]:
        after: int | None = 0
        while after is not None:
            page = client.get(f"/v1/history/{name}?after={after}&limit={PAGE}")
            after = page["next_after"]
            for one in page["readings"]:
                if one["doubt"] == AUDIT and one["answered"] is not None:
                    verdict = json.loads(one["answered"])["verdict"]
                    if verdict != "unreadable":
                        yield from _case(
                            client, one, f"{name} {one['utc_s'] // HOUR_S:.0f}", is_wrong=verdict == "wrong"
                        )


def _case(client: Client, one: dict[str, Any], cluster: str, *, is_wrong: bool) -> Iterator[Case]:
    """Yield a judged reading, unless it has no picture."""
    from service.certificate.record import Case
    from service.certificate.regime import features_of

    features = None if one["crop_url"] is None else features_of(client.fetch("GET", one["crop_url"]))
    if features is not None:
        yield Case(kind=one["kind"], cluster=cluster, is_wrong=is_wrong, features=features)


def _table(certificate: CertificateFile) -> Table:
    table = Table("kind", "cases", "clusters", "wrong", "wrong at most", box=None, pad_edge=False)
    for kind, one in certificate.kinds.items():
        table.add_row(kind, str(one.cases), str(one.clusters), str(one.wrong), f"{one.at_most:.2%}")
    return table
