"""Tests of `/v1/feed`, over HTTP."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from collections.abc import Iterator
from typing import Any

import httpx2
import pytest

from service.http import feed_desk
from service.http.feed_desk import Found, Place
from service.plant import Plant
from service.serve import Panelwright
from tests.service.history.test_store import reading


def test_the_feed_tells_what_has_come_since_in_order(served: Panelwright, client: httpx2.Client) -> None:
    start = client.get("/v1/feed").json()
    assert (start["readings"], start["alarms"]) == ([], [])
    plant = served.service.plant
    plant.history.add([reading(k, float(k)) for k in range(3)])
    lamp = {"object": "pump_lamp", "kind": "lamp", "unit": ""}
    plant.alarms.take([reading(0, None, state="off", **lamp)])
    plant.alarms.take([reading(0, None, state="on", **lamp)])
    asked = f"/v1/feed?readings_after={start['readings_after']}&alarms_after={start['alarms_after']}"
    found = client.get(asked).json()
    assert [one["value"] for one in found["readings"]] == [0.0, 1.0, 2.0]
    assert [one["state"] for one in found["alarms"]] == ["unacknowledged", "returned-unacknowledged"]
    rest = client.get(f"/v1/feed?readings_after={found['readings_after']}&alarms_after={found['alarms_after']}").json()
    assert (rest["readings"], rest["alarms"]) == ([], [])
    assert (
        client.get("/v1/feed?readings_after=999999&alarms_after=0").json()["readings_after"] == found["readings_after"]
    )
    plant.alarms.acknowledge("pump_lamp.state", by="cleaner")


def test_those_who_wait_for_the_feed_share_one_look_and_hold_up_no_read(
    served: Panelwright, client: httpx2.Client, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant, looks, waiting = served.service.plant, list[Place](), 60
    look, has_looked = feed_desk._found, threading.Event()

    def counted(of: Plant, place: Place) -> Found:
        looks.append(place)
        if place.readings_after is not None:
            has_looked.set()
        return look(of, place)

    monkeypatch.setattr(feed_desk, "_found", counted)
    start = client.get("/v1/feed").json()
    asked = f"/v1/feed?readings_after={start['readings_after']}&alarms_after={start['alarms_after']}&wait_s=30"
    known = Place(start["readings_after"], start["alarms_after"])

    async def story() -> list[bytes]:
        limits = httpx2.Limits(max_connections=waiting + 1)
        async with httpx2.AsyncClient(base_url=served.url, trust_env=False, timeout=60.0, limits=limits) as many:
            held = [asyncio.create_task(many.get(asked)) for _ in range(waiting)]
            await asyncio.to_thread(has_looked.wait)
            assert (await many.get("/v1/history")).status_code == 200, "more wait than reads may wait at once"
            plant.history.add([reading(0, 7.5)])
            plant.observations.listeners[0]([])
            return [answer.content for answer in await asyncio.gather(*held)]

    answers = asyncio.run(story())
    assert len(answers) == waiting and len(set(answers)) == 1
    assert [one["value"] for one in json.loads(answers[0])["readings"]] == [7.5]
    assert looks.count(known) <= 3, "one before the reading, one after it"


def test_the_feed_streams_what_comes_and_goes_on_after_the_last_event(
    served: Panelwright, client: httpx2.Client
) -> None:
    plant = served.service.plant

    def events(lines: Iterator[str]) -> Iterator[tuple[str, dict[str, Any]]]:
        number = ""
        for line in lines:
            if line.startswith("id: "):
                number = line[4:]
            elif line.startswith("data: "):
                yield number, json.loads(line[6:])

    with client.stream("GET", "/v1/feed/events") as answer:
        assert answer.headers["content-type"].startswith("text/event-stream")
        found = events(answer.iter_lines())
        last, first = next(found)
        assert (first["readings"], first["alarms"]) == ([], [])
        for value in (1.5, 2.5):
            plant.history.add([reading(0, value)])
            plant.observations.listeners[0]([])
            told, body = next(found)
            assert [one["value"] for one in body["readings"]] == [value]
            assert told == f"{body['readings_after']}-{body['alarms_after']}"
    with client.stream("GET", "/v1/feed/events", headers={"Last-Event-ID": last}) as answer:
        _, body = next(events(answer.iter_lines()))
        assert [one["value"] for one in body["readings"]] == [1.5, 2.5]
    assert client.get("/v1/feed/events", headers={"Last-Event-ID": "yesterday"}).status_code == 422


def test_a_follower_that_does_not_read_loses_nothing_and_holds_up_nobody(
    served: Panelwright, client: httpx2.Client
) -> None:
    plant, batches, rows = served.service.plant, 60, 4  # twelve megabytes: more than the buffers of a connection hold
    address = (served.url.split("//")[1].split(":")[0], int(served.url.rsplit(":", 1)[1]))
    with socket.create_connection(address, timeout=60.0) as slow, slow.makefile("rb") as lines:
        slow.sendall(b"GET /v1/feed/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        while not lines.readline().startswith(b"data: "):
            pass
        with client.stream("GET", "/v1/feed/events") as answer:
            told = (json.loads(line[6:]) for line in answer.iter_lines() if line.startswith("data: "))
            next(told)
            for batch in range(batches):
                plant.history.add([reading(k, float(rows * batch + k), cause="c" * 50_000) for k in range(rows)])
                plant.observations.listeners[0]([])
                assert [one["value"] for one in next(told)["readings"]][-1] == float(rows * batch + rows - 1)
        values = list[float]()
        while len(values) < rows * batches:
            line = lines.readline()
            if line.startswith(b"data: "):
                values += [one["value"] for one in json.loads(line[6:])["readings"]]
    assert values == [float(k) for k in range(rows * batches)]


def test_a_follower_of_an_old_http_is_told_without_chunks(served: Panelwright) -> None:
    plant = served.service.plant
    address = (served.url.split("//")[1].split(":")[0], int(served.url.rsplit(":", 1)[1]))
    with socket.create_connection(address, timeout=60.0) as old, old.makefile("rb") as lines:
        old.sendall(b"GET /v1/feed/events HTTP/1.0\r\nHost: 127.0.0.1\r\n\r\n")
        while not lines.readline().startswith(b"data: "):
            pass
        assert lines.readline() == b"\n"
        for value in (1.5, 2.5):
            plant.observations.keep([reading(0, value)])
            assert lines.readline().startswith(b"id: ")
            assert [one["value"] for one in json.loads(lines.readline()[6:])["readings"]] == [value]
            assert lines.readline() == b"\n"


def test_each_chunk_of_a_stream_is_one_event(served: Panelwright) -> None:
    plant = served.service.plant
    address = (served.url.split("//")[1].split(":")[0], int(served.url.rsplit(":", 1)[1]))
    with socket.create_connection(address, timeout=60.0) as follower, follower.makefile("rb") as lines:
        follower.sendall(b"GET /v1/feed/events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        while lines.readline() != b"\r\n":
            pass
        for value in (None, 1.5, 2.5):
            if value is not None:
                plant.observations.keep([reading(0, value)])
            event = lines.read(int(lines.readline(), 16))
            assert lines.readline() == b"\r\n"
            assert event.startswith(b"id: ") and event.endswith(b"\n\n")
            told = [one["value"] for one in json.loads(event.partition(b"data: ")[2])["readings"]]
            assert told == ([] if value is None else [value])
