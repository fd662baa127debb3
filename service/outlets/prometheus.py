"""Prometheus: the newest readings and the alarms as metrics, on a port of the gateway."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import GaugeMetricFamily, Metric

from hal.errors import CellError
from hal.outlets import PrometheusSection
from service.outlets.deliver import Sleep
from service.outlets.source import CellState, Source

REFRESH_S = 5.0
ALARM_STATES = ("normal", "unacknowledged", "acknowledged", "returned-unacknowledged", "shelved", "out-of-service")


class PrometheusOutlet:
    """Answers scrapes with the state of the cell; while the service is silent there is nothing but `panelwright_up 0`.

    Args:
        sleep: waits between two looks at the cell.
    """

    def __init__(self, section: PrometheusSection, *, cell: str, source: Source, sleep: Sleep = asyncio.sleep) -> None:
        self._section, self._cell, self._source, self._sleep = section, cell, source, sleep
        self._state: CellState | None = None

    async def run(self) -> None:
        """Keep the state fresh and serve it for ever."""
        registry = CollectorRegistry()
        registry.register(self)
        server, _ = start_http_server(self._section.port, self._section.host, registry)
        try:
            while True:
                await self.refresh()
                await self._sleep(REFRESH_S)
        finally:
            server.shutdown()

    async def refresh(self) -> None:
        """Look at the cell."""
        try:
            self._state = await self._source.state()
        except CellError:
            self._state = None  # what is not known now is not told as if it were

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics; called by the registry for each scrape, from another thread."""
        state = self._state
        up = GaugeMetricFamily("panelwright_up", "1 while the service answers", labels=["cell"])
        up.add_metric([self._cell], float(state is not None))
        yield up
        if state is None:
            return
        yield from self._readings(state)
        alarms = GaugeMetricFamily(
            "panelwright_alarm", "1 for the state that an alarm has", labels=["cell", "alarm", "state"]
        )
        active = GaugeMetricFamily("panelwright_alarm_active", "1 while its condition holds", labels=["cell", "alarm"])
        for name, alarm in state.alarms.items():
            active.add_metric([self._cell, name], float(alarm["is_active"]))
            for one in ALARM_STATES:
                alarms.add_metric([self._cell, name, one], float(alarm["state"] == one))
        yield alarms
        yield active

    def _readings(self, state: CellState) -> Iterator[Metric]:
        value = GaugeMetricFamily("panelwright_reading", "newest valid value", labels=["cell", "object", "unit"])
        shown = GaugeMetricFamily(
            "panelwright_reading_state", "1 for the state shown", labels=["cell", "object", "state"]
        )
        valid = GaugeMetricFamily(
            "panelwright_reading_valid", "1 if the newest reading is valid", labels=["cell", "object"]
        )
        at = GaugeMetricFamily(
            "panelwright_reading_time_seconds", "time of the newest reading", labels=["cell", "object"]
        )
        for name, one in state.readings.items():
            valid.add_metric([self._cell, name], float(one["quality"] == "valid"))
            at.add_metric([self._cell, name], float(one["utc_s"]))
            if one["value"] is not None:
                value.add_metric([self._cell, name, one["unit"]], float(one["value"]))
            if one["state"] is not None:
                shown.add_metric([self._cell, name, one["state"]], 1.0)
        yield from (value, shown, valid, at)
