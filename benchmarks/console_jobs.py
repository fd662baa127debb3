"""Four jobs that operators do in the console, each from the panel's page, with as few clicks as it takes."""

from __future__ import annotations

from collections.abc import Callable

from playwright.sync_api import Page

from service.client import Client

Until = Callable[[Page, str], None]


def set_a_limit(page: Page, client: Client, until: Until) -> None:
    """Set a high limit of the pressure gauge."""
    page.click("g[data-object=pressure]")
    page.click("button:text-is('Limits …')")
    page.fill("input[aria-label='high bar']", "9.5")
    page.click("button:text-is('Save limits')")
    until(page, "document.querySelector('.dialog').textContent.includes('high 9.5')")
    client.fetch("DELETE", "/v1/limits/pressure")


def see_a_trend(page: Page, _client: Client, until: Until) -> None:
    """See how the pressure went."""
    page.click("g[data-object=pressure]")
    page.click("a:text-is('More of its history')")
    until(page, "document.querySelector('.nicegui-echart canvas') !== null")
    until(page, "document.querySelector('tbody').textContent.includes('bar')")


def review_a_reading(page: Page, client: Client, until: Until) -> None:
    """Answer the first reading that waits, with one key."""
    if not client.get("/v1/review")["readings"]:
        raise RuntimeError("no reading waits: this run cannot count the clicks of a review")
    page.click("nav a:text-is('Review')")
    page.fill("input[aria-label='Your name, for the record']", "benchmark")
    until(page, "document.querySelector('.answers button') !== null && window.did_handshake")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("1")
    until(page, "document.querySelector('.main').textContent.includes('you have answered 1')")


def work_an_object(page: Page, _client: Client, until: Until) -> None:
    """Set the mode selector to another state."""
    page.click("g[data-object=mode]")
    page.click(".dialog .work button:has-text('Set to') >> nth=0")
    page.click("button:text-is('Yes, move')")
    until(page, "/done\\. It shows|Try:/.test(document.querySelector('.dialog').textContent)")
    if "done. It shows" not in page.inner_text(".dialog"):
        raise RuntimeError(f"it was not set: {page.inner_text('.dialog')}")


JOBS: dict[str, Callable[[Page, Client, Until], None]] = {
    "limit set": set_a_limit,
    "trend seen": see_a_trend,
    "reading reviewed": review_a_reading,
    "object worked": work_an_object,
}
