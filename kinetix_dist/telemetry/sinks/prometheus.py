"""Metrics for Prometheus: the last row of a run at http://127.0.0.1:PORT/metrics, for this machine alone.

"runtime/restarts" is `kinetix_runtime_restarts{run="NAME"}`, "evaluation/s/kick/low" has its set as a label. All are
gauges: what counts since the start of a session begins again with the next one.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import GaugeMetricFamily
from prometheus_client.registry import Collector

from kinetix_dist.telemetry.names import check_metrics, describe

LOOPBACK = "127.0.0.1"


class PortTakenError(ValueError):
    """The port for Prometheus cannot be listened on."""


class PrometheusSink(Collector):
    """Serves what was written last. A thread of its own answers: a reader that hangs costs training nothing."""

    def __init__(self, port: int, *, run: str) -> None:
        """port: on loopback. Raises PortTakenError."""
        self._run = run
        self._values: Mapping[str, float] = {}
        registry = CollectorRegistry()
        registry.register(self)
        try:
            self._server, self._thread = start_http_server(port, addr=LOOPBACK, registry=registry)
        except OSError as error:
            raise PortTakenError(
                f"run.metrics_port {port} cannot be listened on ({error.strerror}); choose another, or 0 for none"
            ) from error

    def write(self, update: int, metrics: Mapping[str, float]) -> None:
        """Replaces what was served before."""
        del update
        self._values = check_metrics(metrics)

    def collect(self) -> Iterator[GaugeMetricFamily]:
        families: dict[str, GaugeMetricFamily] = {}
        for name, value in self._values.items():
            metric = describe(name)
            is_of_set = metric.name != name
            labels = {"run": self._run}
            if is_of_set:
                labels["set"] = name.removeprefix("evaluation/").rpartition("/")[0]
            exported = "kinetix_" + re.sub(r"\W+", "_", metric.name.replace("/<set>", ""))
            help_text = f"{metric.meaning} ({metric.unit})"
            family = families.setdefault(exported, GaugeMetricFamily(exported, help_text, labels=list(labels)))
            family.add_metric(list(labels.values()), value)
        yield from families.values()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()
