"""Tests of webhook, Prometheus, the source of all outlets, the check of the cell file, and the gateway's process."""

from __future__ import annotations

import asyncio
import functools
import hmac
import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx2
import pytest
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from hal.config import load_cell
from hal.errors import ConfigError
from hal.outlets import MqttSection, OutletsSection, PrometheusSection, WebhookSection
from hal.strict import validate
from service.access.keys import Role
from service.client import ApiError
from service.commissioning.outlets import checked_outlets
from service.outlets.api import GATHER_S, ApiSource
from service.outlets.process import outlets_of, run
from service.outlets.prometheus import PrometheusOutlet
from service.outlets.source import Cursor, CursorFile
from service.outlets.webhook import WebhookOutlet
from service.serve import Options, Panelwright
from tests.service.conftest import WriteCell
from tests.service.history.test_store import reading
from tests.service.outlets.fakes import FakeSource, no_pause
from tests.service.verbs import OPERATIONS
from tests.service.waiting import eventually

NOW_S = 1_790_000_000.0


class Receiver:
    """The far side of the webhook: it answers with the statuses that it was given, then with 204."""

    def __init__(self, *statuses: int) -> None:
        self.statuses, self.got = list(statuses), list[httpx2.Request]()

    def __call__(self, request: httpx2.Request) -> httpx2.Response:
        self.got.append(request)
        status = self.statuses.pop(0) if self.statuses else 204
        if status == 0:
            raise httpx2.ConnectError("connection refused", request=request)
        return httpx2.Response(status)


def delivered(folder: Path, source: FakeSource, receiver: Receiver, **given: Any) -> list[dict[str, Any]]:
    """Run the webhook until everything is delivered or dead; returns the dead letters."""
    section = WebhookSection(url="http://plant.example/hook", secret_file="unused", **given)  # noqa: S106 - a path
    cursor, dead = CursorFile(folder / "webhook.json"), folder / "dead.jsonl"
    cursor.save(Cursor(reading=0, alarm=0))
    outlet = WebhookOutlet(
        section,
        cell="bench",
        source=source,
        cursor=cursor,
        secret="s3cret",  # noqa: S106 - of a test
        dead_letters=dead,
        sleep=no_pause,
        now_s=lambda: NOW_S,
        transport=httpx2.MockTransport(receiver),
    )

    async def story() -> None:
        task = asyncio.ensure_future(outlet.run())
        async with asyncio.timeout(30.0):
            while cursor.load() != Cursor(reading=len(source.readings), alarm=len(source.alarms)):  # noqa: ASYNC110 - a file
                await asyncio.sleep(0.005)
        task.cancel()

    asyncio.run(story())
    return [json.loads(line) for line in dead.read_text().splitlines()] if dead.exists() else []


def test_a_change_of_an_alarm_is_sent_signed(tmp_path: Path) -> None:
    source, receiver = FakeSource(), Receiver()
    source.alarms_change()
    source.reads(1.0)
    assert delivered(tmp_path, source, receiver) == []
    (request,) = receiver.got
    body, headers = request.content.decode(), request.headers
    assert json.loads(body)["alarm"]["id"] == "pressure.high"
    assert (headers["x-panelwright-id"], headers["x-panelwright-timestamp"]) == ("bench-alarm-1", f"{NOW_S:.0f}")
    expected = hmac.new(b"s3cret", f"{NOW_S:.0f}.{body}".encode(), "sha256").hexdigest()  # as the documentation says
    assert headers["x-panelwright-signature"] == f"sha256={expected}"


def test_what_fails_is_tried_again_in_order_with_the_same_number(tmp_path: Path) -> None:
    source, receiver = FakeSource(), Receiver(0, 503, 429)
    source.alarms_change()
    source.alarms_change(state="acknowledged")
    assert delivered(tmp_path, source, receiver) == []
    assert [request.headers["x-panelwright-id"][-1] for request in receiver.got] == ["1", "1", "1", "1", "2"]


def test_a_place_is_overwritten_and_an_earlier_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "folder" / "mqtt.json"
    kept = CursorFile(path)
    assert kept.load() == Cursor()
    kept.save(Cursor(reading=10**18, alarm=10**18))
    number = path.stat().st_ino
    kept.save(Cursor(reading=7, alarm=None))
    assert CursorFile(path).load() == Cursor(reading=7, alarm=None)
    assert path.stat().st_ino == number
    path.write_text('{"reading": 12345, "alarm": 67}')
    assert kept.load() == Cursor(reading=12345, alarm=67)
    kept.save(Cursor(reading=1, alarm=2))
    assert kept.load() == Cursor(reading=1, alarm=2)


@pytest.mark.parametrize(("statuses", "tries", "why"), [((503,) * 3, 3, "status 503"), ((400,), 1, "status 400")])
def test_what_cannot_be_delivered_is_kept_and_holds_up_nothing(
    tmp_path: Path, statuses: tuple[int, ...], tries: int, why: str
) -> None:
    source, receiver = FakeSource(), Receiver(*statuses)
    source.reads(1.0)
    source.reads(2.0)
    (dead,) = delivered(tmp_path, source, receiver, tries=3, events=("readings",))
    assert (dead["id"], dead["why"], dead["reading"]["value"]) == ("bench-reading-1", why, 1.0)
    assert len(receiver.got) == tries + 1


def scraped(outlet: PrometheusOutlet) -> dict[tuple[str, str], float]:
    registry = CollectorRegistry()
    registry.register(outlet)
    families = text_string_to_metric_families(generate_latest(registry).decode())
    return {
        (sample.name, "/".join(value for name, value in sample.labels.items() if name != "cell")): sample.value
        for family in families
        for sample in family.samples
    }


def test_prometheus_gets_values_states_and_alarms_and_nothing_old(tmp_path: Path) -> None:
    source = FakeSource()
    source.reads(4.5)
    source.reads(None, object="flow")
    source.alarms_change()
    outlet = PrometheusOutlet(PrometheusSection(), cell="bench", source=source)
    asyncio.run(outlet.refresh())
    found = scraped(outlet)
    assert found["panelwright_reading", "pressure/bar"] == 4.5
    assert found["panelwright_reading_valid", "flow"] == 0.0
    assert ("panelwright_reading", "flow/bar") not in found, "a refused reading has no value"
    assert found["panelwright_alarm", "pressure.high/unacknowledged"] == 1.0
    source.is_silent = True
    asyncio.run(outlet.refresh())
    assert scraped(outlet) == {("panelwright_up", ""): 0.0}


def test_only_what_the_cell_file_asks_for_is_imported(tmp_path: Path) -> None:
    code = (
        "import sys, pathlib; from service.outlets.process import outlets_of; from hal.outlets import *; "
        "outlets_of(OutletsSection(prometheus=PrometheusSection()), cell='a', source=None, folder=pathlib.Path())['prometheus'](); "
        "print(sorted({'aiomqtt', 'paho', 'scipy', 'fastapi'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert outlets_of(OutletsSection(), cell="a", source=FakeSource(), folder=tmp_path) == {}


def test_an_outlet_that_fails_is_made_anew_and_disturbs_no_other() -> None:
    made = dict.fromkeys(("broken", "unmade", "ends", "sound"), 0)
    pauses: list[float] = []

    class Fake:
        def __init__(self, name: str) -> None:
            self._name = name

        async def run(self) -> None:
            if self._name == "broken":
                raise KeyError("a defect")
            if self._name == "sound":
                await asyncio.Event().wait()

    def make(name: str) -> Fake:
        made[name] += 1
        if name == "unmade":
            raise OSError("the file with its password cannot be read")
        return Fake(name)

    async def story() -> None:
        over = asyncio.Event()

        async def sleep(pause_s: float) -> None:
            pauses.append(pause_s)
            if min(made[name] for name in made if name != "sound") == 4:
                over.set()
            await asyncio.sleep(0)

        outlets = {name: functools.partial(make, name) for name in made}
        gateway = asyncio.create_task(run(outlets, sleep=sleep))
        await over.wait()
        assert not gateway.done()
        gateway.cancel()

    asyncio.run(story())
    assert made["sound"] == 1, "it was never restarted"
    assert pauses[:9] == [1.0] * 3 + [2.0] * 3 + [5.0] * 3, "each has pauses of its own, which grow"


@pytest.mark.parametrize(
    ("text", "mode", "told"),
    [(None, 0o600, "cannot be read"), ("", 0o600, "is empty"), ("s", 0o644, "other users may access")],
)
def test_a_secret_that_is_missing_or_open_to_others_is_refused(
    tmp_path: Path, text: str | None, mode: int, told: str
) -> None:
    if text is not None:
        (tmp_path / "secret").write_text(text)
        (tmp_path / "secret").chmod(mode)
    section = OutletsSection(webhook=WebhookSection(url="http://a/b", secret_file="secret"))  # noqa: S106 - a path
    with pytest.raises(ConfigError, match=told):
        checked_outlets(section, tmp_path)


def test_all_faults_of_the_outlets_are_named_at_once(tmp_path: Path) -> None:
    (tmp_path / "open").write_text("s3cret")
    section = OutletsSection(
        mqtt=MqttSection(host="broker", username="a", password_file="open"),  # noqa: S106 - a path
        webhook=WebhookSection(url="http://a/b", secret_file="missing"),  # noqa: S106 - a path
    )
    with pytest.raises(ConfigError, match=r"outlets\.mqtt\.password_file.*and 1 more fault") as caught:
        checked_outlets(section, tmp_path, source="cell.toml")
    assert [str(fault).split(":")[0] for fault in caught.value.details["faults"]] == [
        "outlets.mqtt.password_file",
        "outlets.webhook.secret_file",
    ]


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"opcua": {"username": "scada"}}, "go together"),
        ({"opcua": {"certificate_file": "a.pem"}}, "go together"),
        ({"opcua": {"acknowledge": True}}, "anybody could acknowledge"),
        ({"opcua": {"key_file": "key"}}, "of use only with"),
        ({"opcua": {"port": 9464}, "prometheus": {}}, "both listen at port 9464"),
    ],
)
def test_a_section_that_cannot_be_meant_is_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        validate(given, OutletsSection, source="cell.toml")


def test_a_package_that_is_missing_is_named_with_its_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.commissioning.outlets.find_spec", lambda _name: None)
    with pytest.raises(ConfigError, match="aiomqtt") as caught:
        checked_outlets(OutletsSection(mqtt=MqttSection(host="broker")), tmp_path)
    assert "panelwright[mqtt]" in caught.value.hint


def test_outlets_that_know_equally_much_share_one_request_that_outlives_any_of_them() -> None:
    asked: list[str] = []

    async def story() -> None:
        both, go = asyncio.Event(), asyncio.Event()

        async def answer(request: httpx2.Request) -> httpx2.Response:
            asked.append(request.url.params.get("readings_after"))
            if len(asked) == 2:
                both.set()
            await go.wait()
            return httpx2.Response(200, json={"readings": [], "alarms": [], "readings_after": 8, "alarms_after": 3})

        source = ApiSource("http://127.0.0.1:9", transport=httpx2.MockTransport(answer))
        first, second, other = (
            asyncio.create_task(source.changes(Cursor(reading=at, alarm=3), wait_s=5.0)) for at in (7, 7, 6)
        )
        await both.wait()
        first.cancel()
        go.set()
        assert (await second).cursor == (await other).cursor == Cursor(reading=8, alarm=3)
        await source.changes(Cursor(reading=7, alarm=3), wait_s=5.0)
        await source.close()

    asyncio.run(story())
    assert sorted(asked) == ["6", "7", "7"]


def test_requests_for_changes_leave_a_busy_service_time_to_gather_them() -> None:
    asked_s: list[float] = []

    async def answer(_request: httpx2.Request) -> httpx2.Response:
        asked_s.append(asyncio.get_running_loop().time())
        after = {"readings_after": len(asked_s), "alarms_after": 0}
        return httpx2.Response(200, json={"readings": [], "alarms": [], **after})

    async def story() -> None:
        source = ApiSource("http://127.0.0.1:9", transport=httpx2.MockTransport(answer))
        first = await source.changes(Cursor(reading=0, alarm=0), wait_s=5.0)
        shared = await asyncio.gather(*(source.changes(first.cursor, wait_s=5.0) for _ in range(3)))
        assert [one.cursor for one in shared] == [Cursor(reading=2, alarm=0)] * 3
        await source.close()

    asyncio.run(story())
    first_s, second_s = asked_s
    assert second_s - first_s >= GATHER_S


def test_an_outlet_knows_the_panel_and_acknowledges_and_comments_as_the_service_allows(served: Panelwright) -> None:
    plant = served.service.plant
    lamp = {"object": "pump_lamp", "kind": "lamp", "unit": ""}
    plant.alarms.take([reading(0, None, state="off", **lamp)])

    async def story() -> None:
        source = ApiSource(served.url)
        assert {one.name: one.kind for one in await source.panel()}["pump_lamp"] == "lamp"
        await source.act("pump_lamp.state", "acknowledge", by="scada (OPC UA)", reason="on my way")
        with pytest.raises(ApiError, match="cannot be acknowledged"):
            await source.act("pump_lamp.state", "acknowledge", by="scada (OPC UA)", reason="again")
        await source.act("pump_lamp.state", "comment", by="scada (OPC UA)", reason="a lamp is ordered")
        await source.close()

    asyncio.run(story())
    alarm = plant.alarms.get("pump_lamp.state")
    assert (alarm.state, alarm.by, alarm.reason) == ("acknowledged", "scada (OPC UA)", "a lamp is ordered")
    plant.alarms.take([reading(0, None, state="on", **lamp)])


def test_the_gateway_is_a_process_of_its_own_that_is_started_again(write_cell: WriteCell, tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    cell = load_cell(write_cell(robot=True, extra=f"[outlets.prometheus]\nport = {port}"))
    panelwright = Panelwright(cell, Options(port=0, runs_dir=tmp_path / "runs", inline=True), operations=OPERATIONS)
    book = panelwright.service.keys
    book.add(
        "alice", Role.OPERATOR, valid_s=None, commit=panelwright.service.commit
    )  # so the gateway needs its own key

    def up() -> bool:
        try:
            return 'panelwright_up{cell="fake"} 1.0' in httpx2.get(f"http://127.0.0.1:{port}/metrics").text
        except httpx2.RequestError:
            return False

    try:
        panelwright.start()
        eventually(up)
        gateway = panelwright.gateway
        assert gateway is not None and gateway.pid is not None
        first = gateway.pid
        os.kill(first, signal.SIGKILL)
        eventually(lambda: gateway.pid not in (None, first) and up())
    finally:
        panelwright.close()
