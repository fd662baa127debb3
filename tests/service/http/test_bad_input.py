"""Bad input over HTTP always gets a problem with a 4xx status, never a 5xx or an echo, and nothing moves."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
from collections.abc import Iterator
from typing import Any

import httpx2
import pytest
import schemathesis
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from schemathesis.specs.openapi.checks import response_schema_conformance, status_code_conformance

from service.http.app import create_app
from service.http.guard import Allowed
from service.serve import Panelwright

JSON = {"Content-Type": "application/json"}
CORPUS: dict[str, bytes] = {
    "NaN": b'{"number": NaN}',
    "Infinity": b'{"number": Infinity}',
    "minus Infinity": b'{"number": -Infinity}',
    "1e400": b'{"number": 1e400}',
    "1e300": b'{"number": 1e300}',
    "NaN in a list": b'{"point_m": [0.0, NaN, 0.0]}',
    "1e400 in a list": b'{"point_m": [0.0, 1e400, 0.0]}',
    "text for a number": b'{"number": "1.0"}',
    "text nan": b'{"number": "nan"}',
    "true for a number": b'{"number": true}',
    "number for text": b'{"text": 5}',
    "unknown key": b'{"colour": "red"}',
    "a list": b"[]",
    "a number": b"5",
    "null": b"null",
    "nothing but a brace": b"{",
    "two documents": b"{}{}",
    "trailing comma": b'{"text": "a",}',
    "single quotes": b"{'text': 'a'}",
    "bad UTF-8": b'{"text": "\xff\xfe"}',
    "lone surrogate": b'{"text": "\\ud800"}',
    "UTF-16": '{"text": "a"}'.encode("utf-16"),
    "a zero byte": b'{"text": "a"}\0',
    "deep list": b"[" * 100_000,
    "deep object": b'{"text":' * 50_000,
    "huge integer": b'{"number": ' + b"9" * 10_000 + b"}",
    "long text": json.dumps({"text": "x" * 500_000}).encode(),
    "long point": json.dumps({"point_m": [0.0] * 100_000}).encode(),
    "short point": b'{"point_m": [0.0]}',
}


@pytest.fixture(autouse=True)
def _nothing_moves(client: httpx2.Client, served: Panelwright) -> Iterator[None]:
    """Check for each test that the joints have not moved and that no task may move."""
    mover = served.service.supervisor.connection.mover
    before = mover.state().position_rad.tolist()
    tasks = {task.id for task in served.service.tasks.all()}
    yield
    assert mover.state().position_rad.tolist() == before
    assert not [task for task in served.service.tasks.all() if task.moves and task.id not in tasks]


def _assert_problem(answer: httpx2.Response, *statuses: int) -> None:
    assert answer.status_code in statuses, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem = answer.json()
    assert {"type", "title", "status", "detail", "hint", "retry"} <= set(problem)
    assert problem["status"] == answer.status_code
    assert len(answer.content) < 4000, "an answer must not echo what came"


@pytest.mark.parametrize("verb", ["echo", "hold"])
@pytest.mark.parametrize("name", CORPUS)
def test_a_broken_body_is_refused(client: httpx2.Client, name: str, verb: str) -> None:
    answer = client.post(f"/v1/{verb}", content=CORPUS[name], headers=JSON)
    _assert_problem(answer, 400, 422)


@pytest.mark.parametrize("path", ["/v1/lease", "/v1/stop/reset", "/v1/devices/arm/fault", "/v1/lease/take-over"])
@pytest.mark.parametrize("name", CORPUS)
def test_a_broken_body_is_refused_by_every_route(client: httpx2.Client, name: str, path: str) -> None:
    _assert_problem(client.post(path, content=CORPUS[name], headers=JSON), 400, 422)


@pytest.mark.parametrize(
    ("path", "body"),
    [("/v1/echo", b'{"text": "a", "text": "b"}'), ("/v1/stop/reset", b'{"seen_count": 0, "seen_count": 10}')],
)
def test_a_body_with_one_key_twice_is_refused_by_its_name(client: httpx2.Client, path: str, body: bytes) -> None:
    """JSON libraries take the first or the last of them, so that sender and receiver may mean different things."""
    answer = client.post(path, content=body, headers=JSON)
    _assert_problem(answer, 422)
    assert "more than once" in answer.json()["detail"]


def test_what_was_sent_is_never_repeated(client: httpx2.Client) -> None:
    for body in ({"text": 5, "<script>alert(1)</script>": 1}, {"number": "<script>alert(1)</script>"}):
        answer = client.post("/v1/echo", json=body)
        _assert_problem(answer, 422)
        assert "alert(1)</script>" not in answer.text.replace("body.<script>alert(1)</script>", "")


@pytest.mark.parametrize("query", ["wait_s=nan", "wait_s=inf", "wait_s=-1", "wait_s=31", "wait_s=1e400", "wait_s=x"])
def test_a_broken_query_is_refused(client: httpx2.Client, query: str) -> None:
    _assert_problem(client.post(f"/v1/hold?{query}", json={}), 422)


@pytest.mark.parametrize(
    ("method", "call", "hint"),
    [
        ("post", "/v1/hold?wait=1", "did you mean 'wait_s'?"),
        ("get", "/v1/devices/wrist_camera/reading?format=json&shape=1", "format, max_age_s"),
        ("get", "/v1/devices?name=arm", "no query parameters"),
        ("get", "/healthz?a=1&a=2", "no query parameters"),
        ("post", "/v1/stop/reset?force=1", "no query parameters"),
    ],
)
def test_an_unknown_query_parameter_is_refused_by_name(
    client: httpx2.Client, method: str, call: str, hint: str
) -> None:
    answer = getattr(client, method)(call)
    _assert_problem(answer, 422)
    assert "unknown parameter" in answer.json()["detail"] and hint in answer.json()["hint"]


def test_a_stop_works_whatever_stands_in_its_query(client: httpx2.Client) -> None:
    assert client.post("/v1/stop?force=1").status_code == 200
    assert client.post("/v1/stop/reset", json={"seen_count": client.get("/v1/stop").json()["count"]}).status_code == 200


def test_another_content_type_is_refused(client: httpx2.Client) -> None:
    for media in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        _assert_problem(client.post("/v1/hold", content=b"{}", headers={"Content-Type": media}), 415)


def test_a_huge_body_is_refused_before_it_is_read(client: httpx2.Client) -> None:
    _assert_problem(client.post("/v1/hold", content=b" " * 1_000_001, headers=JSON), 413)


def test_a_body_that_hides_its_length_is_cut_off(client: httpx2.Client) -> None:
    def pieces() -> Iterator[bytes]:
        for _ in range(40):
            yield b" " * 50_000

    _assert_problem(client.post("/v1/hold", content=pieces(), headers=JSON), 413)


@pytest.mark.parametrize(("path", "media"), [("/v1/lease", b"application/json"), ("/v1/images", b"image/png")])
def test_a_client_that_leaves_in_the_middle_of_its_body_is_no_defect(
    served: Panelwright, path: str, media: bytes
) -> None:
    guard = create_app(served.service, allowed=Allowed(hosts=frozenset({"h"}), origins=frozenset()), stop_url="")
    headers = [(b"host", b"h"), (b"content-type", media), (b"content-length", b"9")]
    scope = {"type": "http", "method": "POST", "path": path, "headers": headers, "query_string": b"", "root_path": ""}
    parts: list[Any] = [{"type": "http.request", "body": b'{"', "more_body": True}, {"type": "http.disconnect"}]
    sent: list[Any] = []

    async def receive() -> Any:
        return parts.pop(0)

    async def send(message: Any) -> None:
        sent.append(message)

    asyncio.run(guard({**scope, "http_version": "1.1", "scheme": "http"}, receive, send))
    assert sent[0]["status"] == 400


def _raw(served: Panelwright, request: bytes) -> bytes:
    """Return what is received until the server closes or is silent for a while."""
    answer = b""
    with socket.create_connection(("127.0.0.1", served.port), timeout=1.5) as link:
        link.sendall(request)
        with contextlib.suppress(TimeoutError, ConnectionResetError):
            while piece := link.recv(65536):
                answer += piece
    return answer


@pytest.mark.parametrize(
    "request_bytes",
    [
        b"POST /v1/hold HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 99999999999999999999\r\n\r\n",
        b"POST /v1/hold HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n",
        b"POST /v1/hold HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0x10\r\n\r\n",
        b"POST /v1/hold HTTP/1.1\r\nContent-Length: 2\r\n\r\n{}",
        b"POST /v1/hold HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\nzz",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"GET /\xff\xfe HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET " + b"/x" * 70_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"\r\n\r\n\r\n",
    ],
)
def test_raw_nonsense_gets_4xx_or_a_closed_door(
    served: Panelwright, client: httpx2.Client, request_bytes: bytes
) -> None:
    answer = _raw(served, request_bytes)
    assert answer == b"" or answer.split()[1].startswith(b"4"), answer[:200]
    assert client.get("/healthz").status_code == 200


@pytest.mark.parametrize("host", ["evil.example", "evil.example:80", "127.0.0.1.evil.example", "", "[::2]"])
def test_a_host_that_is_not_ours_is_refused(client: httpx2.Client, host: str) -> None:
    _assert_problem(client.get("/v1/info", headers={"Host": host}), 400)


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://127.0.0.1:1"},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
    ],
)
def test_another_page_in_the_same_browser_cannot_move_the_arm(client: httpx2.Client, headers: dict[str, str]) -> None:
    _assert_problem(client.post("/v1/hold", headers=headers), 403)
    _assert_problem(client.post("/v1/stop/reset", headers=headers), 403)


def test_our_own_page_may(client: httpx2.Client, served: Panelwright) -> None:
    headers = {"Origin": served.url, "Sec-Fetch-Site": "same-origin"}
    assert client.post("/v1/echo?wait_s=10", json={}, headers=headers).status_code == 200


def test_another_pages_websocket_is_refused(served: Panelwright, client: httpx2.Client) -> None:
    head = (
        f"GET /v1/stream HTTP/1.1\r\nHost: 127.0.0.1:{served.port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    )
    assert b" 403 " in _raw(served, f"{head}Origin: http://evil.example\r\n\r\n".encode()).split(b"\r\n")[0]


@pytest.mark.parametrize(
    "path",
    [
        "/v1/missions/../../etc/passwd",
        "/v1/missions/..%2f..%2fetc/passwd",
        "/v1/missions/.service/journal.sqlite",
        "/v1/missions/%2e%2e/journal.sqlite",
        "/v1/missions/a/..%2f.service%2fjournal.sqlite",
        "/v1/tasks/..%2f..%2f/artefacts/x",
        "/v1/tasks/x/artefacts/..%2f..%2fjournal.sqlite",
        "/..%2f..%2fcore.py",
        "/../core.py",
        "/%2e%2e/core.py",
        "//etc/passwd",
        "/v1/devices/..%2f..%2f/reading",
        "/v1/tasks/%00",
        "/%00",
    ],
)
def test_no_path_leads_outside(client: httpx2.Client, served: Panelwright, path: str) -> None:
    request = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"
    answer = _raw(served, request.encode())
    assert answer.split()[1] in (b"404", b"422", b"400"), answer[:200]
    assert b"root:" not in answer
    assert b"SQLite" not in answer


def test_a_missions_file_behind_a_link_is_not_served(client: httpx2.Client, served: Panelwright) -> None:
    folder = served.service.runs_dir / "linked"
    folder.mkdir(exist_ok=True)
    link = folder / "secret.txt"
    link.symlink_to("/etc/passwd")
    _assert_problem(client.get("/v1/missions/linked/secret.txt"), 404)
    link.unlink()


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("PUT", "/v1/lease", "GET, POST"),
        ("DELETE", "/v1/lease", "GET, POST"),
        ("GET", "/v1/echo", "POST"),
        ("PATCH", "/v1/echo", "POST"),
        ("OPTIONS", "/v1/tasks", "GET"),
        ("POST", "/v1/devices/arm", "GET, PUT"),
        ("POST", "/v1/tasks/0/events", "GET"),
        ("POST", "/api.js", "GET, HEAD"),
    ],
)
def test_wrong_methods_are_405_and_the_right_ones_are_named(
    client: httpx2.Client, method: str, path: str, allowed: str
) -> None:
    answer = client.request(method, path)
    _assert_problem(answer, 405)
    assert answer.headers["allow"] == allowed
    assert answer.json()["detail"] == f"this path takes {allowed} only"


@pytest.mark.parametrize("method", ["GET", "PUT", "POST", "OPTIONS"])
def test_a_path_that_nobody_knows_is_404_whatever_the_method(client: httpx2.Client, method: str) -> None:
    answer = client.request(method, "/v1/nothing")
    _assert_problem(answer, 404)
    assert "allow" not in answer.headers


@pytest.mark.parametrize(
    ("path", "hint"),
    [
        ("/v1/echoo", "did you mean /v1/echo? /openapi.json lists all paths"),
        ("/v1/leese", "did you mean /v1/lease? /openapi.json lists all paths"),
        ("/" + "z" * 5000, "/openapi.json lists all paths"),
        ("/zzz%00", "/openapi.json lists all paths"),
    ],
)
def test_a_mistyped_path_is_told_the_right_one(client: httpx2.Client, path: str, hint: str) -> None:
    answer = client.post(path)
    assert (answer.status_code, answer.json()["hint"]) == (404, hint)
    assert "zzz" not in answer.text


@given(body=st.binary(max_size=300))
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_bytes_are_4xx(client: httpx2.Client, body: bytes) -> None:
    """Random bytes are hardly ever a valid body, except `{}` with spaces, which selects the defaults."""
    answer = client.post("/v1/measure", content=body, headers=JSON)
    assert answer.status_code < 500
    if body.strip() not in (b"{}", b""):
        _assert_problem(answer, 400, 422)


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=20,
)
KEYS = st.sampled_from(["text", "number", "point_m", "fault", "magnitude", "holder", "seen_count", "seconds"])


@given(path=st.sampled_from(["measure", "echo", "devices/arm/fault", "lease"]), body=st.dictionaries(KEYS, ANY_JSON))
@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_json_is_never_5xx(client: httpx2.Client, path: str, body: dict[str, object]) -> None:
    answer = client.post(f"/v1/{path}", content=json.dumps(body).encode(), headers=JSON)
    assert answer.status_code < 500, answer.text
    json.loads(answer.content, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))


def test_the_api_document_keeps_its_word(client: httpx2.Client, served: Panelwright) -> None:
    """Generated requests to every operation get no undeclared 5xx, and every answer fits its schema."""
    schema = schemathesis.openapi.from_dict(client.get("/openapi.json").json())
    schema.config.update(base_url=served.url)
    tried = 0
    for result in schema.get_all_operations():
        operation = result.ok()
        if operation.path in SKIPPED:
            continue

        @given(case=operation.as_strategy())
        @settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck), database=None)
        def check(case: schemathesis.Case) -> None:
            if case.query and "wait_s" in case.query:
                case.query.pop("wait_s")  # otherwise each request would wait for 30 s
            answer = case.call(headers={"Connection": "close"})
            assert answer.status_code < 500 or answer.status_code in (502, 503, 504), answer.text
            checks = [status_code_conformance, response_schema_conformance]
            case.validate_response(answer, checks=checks, excluded_checks=[])

        check()
        tried += 1
    assert tried >= 20


SKIPPED = {
    "/v1/hold",  # would move; its bodies are covered by the tests above
    "/v1/wait",
    "/v1/tasks/{task_id}/events",  # a stream
    "/v1/feed/events",  # likewise, without an end
}
