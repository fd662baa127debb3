"""Every path in the pages about the API exists, and every path of the API is documented."""

from __future__ import annotations

import re
from pathlib import Path

import httpx2

from service.operations import OPERATIONS
from service.problem import STATUS

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "http.md"
NOT_SHOWN = {"/v1/echo", "/v1/hold", "/v1/wait", "/v1/fail", "/v1/measure", "/v1/note"}  # verbs of these tests


def _documented() -> set[str]:
    """Return the paths in the page about the API; "`POST /v1/a`, `/v1/b`" counts for both."""
    text = PAGE.read_text(encoding="utf-8").replace("$TASK", "ID")
    found = re.findall(r"(?:localhost:846[01]|[` (])(/(?:v1/[\w{}./-]+|healthz|readyz|metrics))", text)
    return {path.rstrip(".").replace("/ID/", "/{task_id}/") for path in found}


def test_every_path_is_documented_and_every_documented_path_exists(client: httpx2.Client) -> None:
    served = set(client.get("/openapi.json").json()["paths"]) - NOT_SHOWN
    verbs = {f"/v1/{name}" for name in OPERATIONS}
    examples = {path for path in _documented() if re.search(r"/devices/w|/v1/tasks/\{id\}|/v1/stream", path)}
    assert _documented() - examples == served | verbs


def test_every_status_of_an_error_is_documented() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert not [int(status) for status in STATUS.values() if str(int(status)) not in text]


def test_the_documented_ports_are_the_default_ones() -> None:
    from service.serve import Options

    assert f"http://127.0.0.1:{Options().port}" in PAGE.read_text(encoding="utf-8")


def test_every_verb_has_a_valid_example() -> None:
    for operation in OPERATIONS.values():
        import json

        operation.request_model.model_validate_json(json.dumps(operation.example), strict=True)
