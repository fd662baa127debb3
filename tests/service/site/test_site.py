"""Many cells side by side: one of them dead, one another program; their histories in one folder, and questions about them."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from hal.errors import ConfigError, InvalidRequest
from service.cli import _app
from service.errors import HistoryError
from service.history.parts import write_parquet
from service.serve import Panelwright
from service.site.ask import ask, readings_of, trends_of
from service.site.collect import ALL, collect
from service.site.look import Cells
from service.site.page import page_of
from service.site.site_file import load_site
from tests.service.history.test_store import reading

NOV, DEC, JAN = 1_793_500_000.0, 1_796_500_000.0, 1_799_500_000.0  # 2026-11-01, 2026-12-05, 2027-01-09


@pytest.fixture
def dead_url() -> Iterator[str]:
    """Yield an address at which nobody listens: a port that is bound and not open."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"http://127.0.0.1:{taken.getsockname()[1]}"


@pytest.fixture
def site(served: Panelwright, dead_url: str, tmp_path: Path) -> Path:
    path = tmp_path / "site.toml"
    cells = {"north": served.url, "dead": dead_url, "south": served.url}
    lines = [f'[[cells]]\nname = "{name}"\nurl = "{url}"' for name, url in cells.items()]
    path.write_text("\n".join(['schema = 1\nname = "Works <1>"', *lines]), encoding="utf-8")
    return path


def cells_of(path: Path) -> Cells:
    return Cells(site=load_site(path), folder=path.parent)


def run(*words: str, code: int = 0) -> str:
    done = CliRunner().invoke(_app(), list(words), env={"COLUMNS": "200"})
    assert done.exit_code == code, (done.output, done.exception)
    return done.output


def test_cells_are_shown_side_by_side_and_a_dead_one_says_so(site: Path, served: Panelwright) -> None:
    served.service.plant.alarms.take([reading(0, None, object="pump_lamp", kind="lamp", state="off", unit="")])
    north, dead, south = cells_of(site).look()
    assert (north.answers, dead.answers, south.answers) == (True, False, True)
    assert "no panelwright service answers" in dead.why
    assert (north.cell, north.state) == ("fake", "ready")
    assert [alarm["id"] for alarm in south.unseen] == ["pump_lamp.state"]
    page = site.with_name("site.html")
    told = run("site", "show", str(site), "--page", str(page), code=1)
    assert "does not answer" in told
    assert "pump_lamp.state" in told
    text = page.read_text(encoding="utf-8")
    assert "<h1>Works &lt;1&gt;</h1>" in text
    assert "2 of 3 cells answer" in text
    assert "does not answer" in text
    assert "src=" not in text, "nothing is loaded from elsewhere"


def test_another_program_at_the_address_is_no_cell(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: dict[str, Any] = {"/v1/info": {"name": "a shop"}, "/v1/stop": []}
    monkeypatch.setattr("service.client.Client.get", lambda _self, path: answers.get(path, {}))
    assert all("not understood" in one.why for one in cells_of(site).look())


def test_a_page_links_only_to_web_addresses(site: Path) -> None:
    from dataclasses import replace

    found = cells_of(site).look()
    bad = replace(found[0], console_url="javascript:alert(1)")
    assert "javascript:" not in page_of("w", [bad], NOV)
    assert "<b>x</b>" not in page_of("w", [replace(found[0], state="<b>x</b>")], NOV, renew_s=5.0)


def test_a_site_file_names_all_faults(tmp_path: Path) -> None:
    path = tmp_path / "site.toml"
    path.write_text('[[cells]]\nname = "a"\nurl = "ftp://x"\n[[cells]]\nname = "B"\nurl = "http://x"\nport = 5\n')
    with pytest.raises(ConfigError) as refused:
        load_site(path)
    told = "\n".join(str(fault) for fault in refused.value.details["faults"])
    assert all(key in told for key in ("cells.0.url", "cells.1.name", "cells.1.port"))
    path.write_text('[[cells]]\nname = "a"\nurl = "http://x"\n[[cells]]\nname = "a"\nurl = "http://y"\n')
    with pytest.raises(ConfigError, match="several cells are called a"):
        load_site(path)


def test_histories_are_collected_month_by_month_and_again_with_later_answers(
    site: Path, served: Panelwright, tmp_path: Path
) -> None:
    history, folder = served.service.plant.history, tmp_path / "years"
    given = {"object": "flow", "kind": "gauge", "unit": "l/min"}
    for utc_s, value in ((NOV, 1.0), (DEC, 2.0), (JAN, 3.0)):
        history.add([reading(0, value, utc_s=utc_s, **given)])
    history.add([reading(0, None, utc_s=JAN + 5.0, cause='a "glare", cut', doubt="it was refused", crop="ab", **given)])
    done = list(collect(cells_of(site), folder))
    assert [(one.name, bool(one.why)) for one in done] == [("north", False), ("dead", True), ("south", False)]
    assert {path.name for path in (folder / "north").iterdir()} >= {
        f"readings-{month}.parquet" for month in ("2026-11", "2026-12", "2027-01")
    }
    rows = readings_of(folder, "flow", since_s=0.0, cell="south")
    assert [row["value"] for row in rows] == [1.0, 2.0, 3.0, None]
    assert (rows[3]["cause"], rows[3]["doubt"], rows[0]["cause"], rows[0]["crop"]) == (
        'a "glare", cut',
        "it was refused",
        "",
        None,
    )
    waiting = [row.id for row in history.reader().waiting("fake") if row.reading.object == "flow"]
    history.answer(waiting[0], said=json.dumps({"by": "alice"}), value=4.0, state=None, text=None)
    old = (folder / "north/readings-2026-11.parquet").stat().st_mtime_ns
    list(collect(cells_of(site), folder))
    assert (folder / "north/readings-2026-11.parquet").stat().st_mtime_ns == old, "a month that is over stays"
    trends = trends_of(folder, "flow", since_s=NOV, until_s=JAN + 10.0, buckets=3)
    assert list(trends) == ["north", "south"]
    assert [(one["count"], one["refused"], one["maximum"]) for one in trends["north"]] == [
        (1, 0, 1.0),
        (1, 0, 2.0),
        (2, 0, 4.0),
    ]


def test_the_commands_ask_the_folder(site: Path, served: Panelwright, tmp_path: Path) -> None:
    served.service.plant.history.add([reading(0, 5.5, object="level", utc_s=NOV)])
    folder = tmp_path / "years"
    assert "readings in" in run("site", "collect", str(site), "--into", str(folder), code=1)
    told = run(
        "site",
        "ask",
        str(folder),
        "SELECT cell, MAX(value) AS top FROM readings WHERE object = 'level' GROUP BY 1 ORDER BY 1",
    )
    assert [line.split() for line in told.splitlines()] == [["cell", "top"], ["north", "5.5"], ["south", "5.5"]]
    files = [str(tmp_path / "level.csv"), str(tmp_path / "level.png")]
    told = run("history", "level", "--from", str(folder), "--since", "2000w", "--csv", files[0], "--plot", files[1])
    assert told.count("5.5 bar") == 2
    assert Path(files[0]).read_text().count("level") == 2
    assert Path(files[1]).read_bytes().startswith(b"\x89PNG")
    assert told != run("history", "level", "--from", str(folder), "--since", "2000w", "--of", "north")
    assert "no reading of" in run("history", "nothing", "--from", str(folder))


def test_a_folder_that_cannot_be_asked_says_why(tmp_path: Path) -> None:
    with pytest.raises(InvalidRequest, match="no collected history"):
        ask(tmp_path, "SELECT 1")
    (tmp_path / "a").mkdir()
    part = tmp_path / "a/readings-2026-11.parquet"
    write_parquet(part, ALL, [["a", 1, *[None] * (len(ALL) - 2)]])
    with pytest.raises(InvalidRequest, match="cannot be answered"):
        ask(tmp_path, "SELECT nothing_such FROM readings")
    part.write_bytes(b"PAR1 not at all")
    with pytest.raises(HistoryError, match="cannot be read"):
        ask(tmp_path, "SELECT 1 FROM readings")
