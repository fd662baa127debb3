"""Metrics for operators: event-loop lag, tasks, latch and processes; one registry per application."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Iterator

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from service.core import Service

LAG_PROBE_S = 0.02
LAG_BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
KEPT_LAGS = 3000  # one minute of samples


class Metrics:
    """Collects the metrics; `text` returns them in Prometheus' text format."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._registry = CollectorRegistry()
        self._lag = Histogram(
            "panelwright_event_loop_lag_seconds",
            "delay of timers in the event loop",
            buckets=LAG_BUCKETS,
            registry=self._registry,
        )
        self._lags_s: deque[float] = deque(maxlen=KEPT_LAGS)
        self._answers: Counter[int] = Counter()
        self._registry.register(self)

    async def probe_lag(self) -> None:
        """Measure endlessly how late timers fire; run as a task of the event loop."""
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + LAG_PROBE_S
            await asyncio.sleep(LAG_PROBE_S)
            lag_s = max(0.0, loop.time() - due_s)
            self._lags_s.append(lag_s)
            self._lag.observe(lag_s)

    def count_answer(self, status: int) -> None:
        """Count an answer with this status."""
        self._answers[status] += 1

    def lag_p99_s(self) -> float:
        """Return the 99th percentile of the lag over the last minute, s."""
        lags = sorted(self._lags_s)
        return lags[int(0.99 * (len(lags) - 1))] if lags else 0.0

    def text(self) -> bytes:
        """Return all metrics in Prometheus' text format."""
        return bytes(generate_latest(self._registry))

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics; called by the registry."""
        tasks = GaugeMetricFamily("panelwright_tasks", "kept tasks by state", labels=["state"])
        for state, count in Counter(str(task.state) for task in self._service.tasks.all()).items():
            tasks.add_metric([state], count)
        yield tasks
        latched = float(self._service.supervisor.latch.is_set())
        yield GaugeMetricFamily("panelwright_stop_latched", "1 while the software stop is latched", value=latched)
        ready = float(self._service.supervisor.is_ready)
        yield GaugeMetricFamily("panelwright_cell_ready", "1 while the cell process is up", value=ready)
        missing = float(len(self._service.supervisor.missing))
        yield GaugeMetricFamily("panelwright_devices_missing", "devices that are not connected", value=missing)
        restarts = CounterMetricFamily("panelwright_restarts", "restarts of supervised processes", labels=["process"])
        for process in self._service.supervisor.processes():
            restarts.add_metric([process.name], process.restarts)
        yield restarts
        answers = CounterMetricFamily("panelwright_answers", "HTTP answers by status", labels=["status"])
        for status, count in self._answers.items():
            answers.add_metric([str(status)], count)
        yield answers
