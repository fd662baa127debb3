"""What the dialog of one object tells: its newest reading, its trend and its last pictures, as HTML."""

from __future__ import annotations

from typing import Any

from hal.panel import PanelObject
from service.console.page_frame import clock
from service.console.panel_drawing import is_off
from service.console.texts import say, word
from service.console.values import Reading, age, attribute, confidence, label_of, number, shown, sigma

TREND_W, TREND_H = 480, 90


def facts_html(one: PanelObject, reading: Reading | None, alarm: dict[str, Any] | None) -> str:
    """Return what the object shows now, where that is from, and its alarm."""
    parts = [f"<h2>{attribute(label_of(one))} <span class='quiet'>{attribute(one.kind.replace('_', ' '))}</span></h2>"]
    value = shown(one, reading)
    parts.append(f'<p style="font-size:1.7rem;margin:.2rem 0"><b id="dialog-value">{attribute(value)}</b> ')
    sure = confidence(reading)
    facts = [sigma(one, reading), say("object.confidence", share=sure) if sure else ""]
    told = " · ".join(attribute(fact) for fact in facts if fact)
    aged = say("object.age", age=age(reading)) if reading is not None else ""
    parts.append(f'<span class="quiet">{" · ".join(part for part in (told, aged) if part)}</span></p>')
    if reading is not None:
        if reading["quality"] != "valid":
            parts.append(f'<p class="warn">{attribute(say("object.refused", cause=reading["cause"]))}</p>')
        elif told := certified(reading):
            parts.append(f'<p class="quiet">{attribute(told)}</p>')
        taken = {"verb": word("verb", reading["verb"]), "when": clock(reading["utc_s"])}
        phase = reading["phase"]
        where = say("object.from.phase", **taken, phase=phase) if phase else say("object.from", **taken)
        parts.append(f'<p class="quiet">{attribute(where)}</p>')
    if alarm is not None:
        look, told = alarm_line(alarm)
        parts.append(f'<p class="{look}">{attribute(told)}</p>')
    return "".join(parts)


def certified(reading: Reading) -> str:
    """Return whether a reading is sure, and what its certificate says or why it has none."""
    if not reading["sure"]:
        return say("object.unsure", why=reading["doubt"])
    said = reading["certificate"]
    if said is None or said["none"] is not None:
        return say("object.sure", why="" if said is None else said["none"]).rstrip()
    share, assurance = f"{100 * said['at_most']:.2g} %", f"{100 * said['assurance']:.0f} %"
    counts = {key: said[key] for key in ("cases", "wrong", "source")}
    return say("object.certified", share=share, assurance=assurance, **counts)


def alarm_line(alarm: dict[str, Any]) -> tuple[str, str]:
    """Return an alarm in words, with how urgent it looks: `bad` only while it calls for somebody."""
    if is_off(alarm):
        until = f" {say('alarms.until', when=clock(alarm['shelved_until_s']))}" if alarm["shelved_until_s"] else ""
        holds = alarm["says"] if alarm["is_active"] else say("alarms.gone")
        return "quiet", say("object.alarm_off", state=f"{word('alarm', alarm['state'])}{until}", says=holds)
    if alarm["is_active"]:
        advice = alarm["what_to_do"]
        return "bad", say("object.alarm", says=alarm["says"], what_to_do=advice[:1].upper() + advice[1:]).rstrip()
    return "warn", say("object.alarm_over", says=alarm["says"])


def history_html(one: PanelObject, readings: list[Reading]) -> str:
    """Return the trend of the values, and the last pictures."""
    if not readings:
        return f'<p class="quiet">{say("object.no_history")}</p>'
    crops = [
        f'<img src="/relay{attribute(row["crop_url"])}" alt="{attribute(say("object.crop", when=clock(row["utc_s"])))}" '
        f'title="{attribute(clock(row["utc_s"]))}: {attribute(shown(one, row))}">'
        for row in readings[:-7:-1]
        if row["crop_url"]
    ]
    pictures = f'<h2>{say("object.pictures")}</h2><div class="crops">{"".join(crops)}</div>' if crops else ""
    more = f'<p><a href="/history?object={one.name}">{say("history.more")}</a></p>'
    return f"<h2>{say('object.history')}</h2>{_trend(one, readings)}{more}{pictures}"


def _trend(one: PanelObject, readings: list[Reading]) -> str:
    """Return values over time as a line, states as a list of changes."""
    valued = [row for row in readings if row["value"] is not None and row["state"] is None]
    if len(valued) < 2:
        changes = [row for k, row in enumerate(readings) if k == 0 or shown(one, row) != shown(one, readings[k - 1])]
        lines = "".join(
            f"<li>{attribute(clock(row['utc_s']))} · {attribute(shown(one, row))}</li>" for row in changes[:-9:-1]
        )
        return f"<ul>{lines}</ul>"
    times, values = [row["utc_s"] for row in valued], [row["value"] for row in valued]
    low, high, since, span = min(values), max(values), times[0], max(times[-1] - times[0], 1.0)
    height = max(high - low, 0.05 * (one.full_scale or 0.0), 1e-9)  # the noise of a steady value stays a flat line
    top = (high + low + height) / 2
    points = " ".join(
        f"{TREND_W * (t - since) / span:.1f},{6 + (TREND_H - 12) * (top - v) / height:.1f}"
        for t, v in zip(times, values, strict=True)
    )
    label = say("object.trend", count=len(valued), first=clock(times[0]), last=clock(times[-1]))
    ends = f"{attribute(number(one, low, valued[0]))} – {attribute(number(one, high, valued[0]))}"
    return (
        f'<svg viewBox="0 0 {TREND_W} {TREND_H}" role="img" aria-label="{attribute(label)}" width="100%">'
        f'<polyline class="trend" points="{points}"/></svg><p class="quiet">{ends} · {attribute(label)}</p>'
    )
