"""The site as one page: a card for each cell, with everything in the file, so that it needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from urllib.parse import urlsplit

from service.site.look import CellLook

MOST_ALARMS, MOST_READINGS = 8, 40
STYLE = """
:root { color-scheme: light dark; --ink: #1c2733; --soft: #5a6b7c; --line: #d5dde5; --card: #fff; --back: #f3f6f9;
  --good: #1a7f4b; --bad: #b3261e; --warn: #8a5a00; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6edf3; --soft: #9fb0c0; --line: #33414f; --card: #1b242d; --back: #11181f;
  --good: #5fd39a; --bad: #ff8a80; --warn: #f2c063; } }
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem; color: var(--ink); background: var(--back); }
h1 { font-size: 1.35rem; margin: 0; } h2 { font-size: 1.1rem; margin: 0; } p { margin: .25rem 0; }
.cells { display: grid; grid-template-columns: repeat(auto-fill, minmax(21rem, 1fr)); gap: 1rem; margin-top: 1rem; }
.cell { background: var(--card); border: 1px solid var(--line); border-left: .4rem solid var(--good); border-radius: .5rem;
  padding: .8rem 1rem; } .cell.bad { border-left-color: var(--bad); } .cell.warn { border-left-color: var(--warn); }
.soft { color: var(--soft); } .bad b, b.bad { color: var(--bad); } b.warn { color: var(--warn); } b.good { color: var(--good); }
table { border-collapse: collapse; width: 100%; margin-top: .5rem; font-variant-numeric: tabular-nums; }
td { padding: .1rem .5rem .1rem 0; border-top: 1px solid var(--line); vertical-align: top; } td.right { text-align: right; }
"""


def page_of(name: str, cells: Sequence[CellLook], now_s: float, *, renew_s: float | None = None) -> str:
    """Return the page as HTML.

    Args:
        now_s: when the cells were looked at, seconds since 1970.
        renew_s: after which time a browser loads it again; None: never.
    """
    answering = sum(cell.answers for cell in cells)
    unseen = sum(len(cell.unseen) for cell in cells)
    waiting = sum(cell.waiting for cell in cells)
    renew = "" if renew_s is None else f'<meta http-equiv="refresh" content="{renew_s:.0f}">'
    told = f"{answering} of {len(cells)} cells answer; {unseen} alarms unacknowledged; {waiting} readings wait for a person"
    cards = "\n".join(_card(cell, now_s) for cell in cells)
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(name)}</title>{renew}'
        f'<meta name="viewport" content="width=device-width, initial-scale=1"><style>{STYLE}</style></head><body>'
        f'<h1>{escape(name)}</h1><p class="soft">{told}; as of {time_of(now_s)} UTC</p><main class="cells">\n{cards}\n'
        "</main></body></html>\n"
    )


def _card(cell: CellLook, now_s: float) -> str:
    if not cell.answers:
        return (
            f'<section class="cell bad"><h2>{escape(cell.name)}</h2><p><b class="bad">does not answer</b></p>'
            f'<p class="soft">{escape(cell.why)}</p></section>'
        )
    kind = "bad" if cell.unseen or cell.state != "ready" else "warn" if cell.alarms or cell.waiting else ""
    colour = "good" if cell.state == "ready" else "bad"
    parts = [
        f'<section class="cell {kind}"><h2>{_link(cell)}</h2>',
        f'<p><b class="{colour}">{escape(cell.state)}</b> <span class="soft">{escape(cell.cell)}, panel '
        f"{escape(cell.panel)}, {escape(cell.mode)}</span></p>",
        f"<p>{len(cell.unseen)} of {len(cell.alarms)} alarms unacknowledged, {cell.waiting} readings wait</p>",
        _next_round(cell),
        *(_alarm(alarm) for alarm in cell.alarms[:MOST_ALARMS]),
        _readings(cell, now_s),
        "</section>",
    ]
    return "".join(parts)


def _link(cell: CellLook) -> str:
    """Return the cell's name with a link to its console, or else to its API; nothing but http and https is linked."""
    address = cell.console_url or cell.url
    if urlsplit(address).scheme not in ("http", "https"):
        return escape(cell.name)
    return f'<a href="{escape(address, quote=True)}">{escape(cell.name)}</a>'


def _next_round(cell: CellLook) -> str:
    following = cell.next_round
    if following is None:
        return '<p class="soft">no rounds</p>'
    return f'<p class="soft">round {escape(str(following["name"]))} at {time_of(following["next_s"])} UTC</p>'


def _alarm(alarm: dict[str, object]) -> str:
    style = "bad" if "unacknowledged" in str(alarm["state"]) else "warn"
    return f'<p><b class="{style}">{escape(str(alarm["state"]))}</b> {escape(str(alarm["says"]))}</p>'


def _readings(cell: CellLook, now_s: float) -> str:
    rows = "".join(
        f"<tr><td>{escape(one['object'])}</td><td>{escape(shown(one))}</td>"
        f'<td class="right soft">{age_of(now_s - one["utc_s"])}</td></tr>'
        for one in cell.newest[:MOST_READINGS]
    )
    return f"<table>{rows}</table>" if rows else '<p class="soft">no readings yet</p>'


def shown(one: dict[str, object]) -> str:
    """Return what a reading of the API shows, in words."""
    if one["quality"] != "valid":
        return "refused"
    if one["text"] is not None or one["state"] is not None:
        return str(one["text"] or one["state"]).strip()
    return f"{one['value']:.4g} {one['unit']}".strip()


def age_of(age_s: float) -> str:
    """Return an age in words, such as `3 h`."""
    for unit_s, unit in ((86_400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if age_s >= unit_s:
            return f"{age_s / unit_s:.0f} {unit}"
    return f"{max(0.0, age_s):.0f} s"


def time_of(utc_s: float) -> str:
    """Return a time, seconds since 1970, as UTC to the minute."""
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d %H:%M")
