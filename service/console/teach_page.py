"""Teach by clicks: the form of the service's own teach page as a page of the console, which passes its calls on."""

from __future__ import annotations

import re
from pathlib import Path

from nicegui import ui

from service.console.page_frame import Place, page_frame
from service.console.texts import say

PATH = "/teach"
SERVICE_WEB = Path(__file__).parents[1] / "web"
SCRIPTS = ("teach.js", "teach-image.js", "teach-learn.js", "teach-panel.js", "api.js", "stop.js", "teach.css")
FORM = re.compile(r'<main class="teach">(.*)</main>', re.DOTALL)
# NiceGUI builds the page in the browser, so that the scripts of the form wait until it is there.
BEGIN = """<script type="module">
const begin = () => document.querySelector("#known") ? import("/teach/teach.js") : setTimeout(begin, 30);
begin();
</script>"""


def install(place: Place) -> None:
    """Add the page at `/teach`."""
    found = FORM.search((SERVICE_WEB / "teach.html").read_text(encoding="utf-8"))
    form = found.group(1) if found is not None else ""

    @ui.page(PATH, title=f"{say('teach.title')} · {say('title')}")
    def teach_page() -> None:
        with page_frame(place, "setup"):
            ui.add_head_html('<link rel="stylesheet" href="/teach/teach.css">')
            ui.html('<p id="complaint" class="banner bad" role="alert" hidden></p>', sanitize=False).style(
                "grid-column: span 12"
            )
            ui.html(form, sanitize=False).classes("teach")
            ui.add_body_html(BEGIN)
