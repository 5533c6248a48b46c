"""Metrics for Prometheus, scraped over HTTP."""

import math
import socket
import urllib.request

import pytest
from prometheus_client.parser import text_string_to_metric_families

from kinetix_dist.telemetry.names import UnknownMetricError
from kinetix_dist.telemetry.sinks.prometheus import PortTakenError, PrometheusSink
from tests.helpers import PATIENCE_S, free_port


def scrape(port: int) -> dict[tuple[str, str], float]:
    """Values by name and level set."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE_S) as answer:
        text = answer.read().decode()
    families = text_string_to_metric_families(text)
    return {(s.name, s.labels.get("set", "")): s.value for family in families for s in family.samples}


@pytest.fixture
def served():
    port = free_port()
    sink = PrometheusSink(port, run="a")
    yield port, sink
    sink.close()


def test_the_last_row_is_what_is_scraped(served):
    port, sink = served
    assert scrape(port) == {}
    sink.write(1, {"train/solve_rate": 0.25})
    rates = {"evaluation/s/kick/low": 0.1, "evaluation/random_s/low": 0.2}
    sink.write(2, {"train/solve_rate": 0.5, "train/mean_return": math.nan, **rates})
    found = scrape(port)
    assert found["kinetix_train_solve_rate", ""] == 0.5
    assert found["kinetix_evaluation_low", "s/kick"] == 0.1 and found["kinetix_evaluation_low", "random_s"] == 0.2
    assert math.isnan(found["kinetix_train_mean_return", ""])
    with pytest.raises(UnknownMetricError):
        sink.write(3, {"learner/magic": 1.0})


def test_it_listens_on_loopback_alone(served):
    address = socket.gethostbyname(socket.gethostname())
    others = {address, "127.0.0.2"} - {"127.0.0.1"}  # all of 127/8 is loopback; it listens at one address of it
    for other in others:
        with pytest.raises(OSError):
            socket.create_connection((other, served[0]), timeout=2)


def test_a_port_that_is_taken_is_refused_and_one_that_was_closed_is_free_again():
    port = free_port()
    first = PrometheusSink(port, run="a")
    with pytest.raises(PortTakenError, match=rf"metrics_port {port} cannot be listened on \(Address already in use"):
        PrometheusSink(port, run="b")
    first.close()
    PrometheusSink(port, run="b").close()


def test_a_scraper_that_hangs_stops_nobody(served):
    port, sink = served
    with socket.create_connection(("127.0.0.1", port)):  # asks for nothing, and stays
        sink.write(1, {"train/solve_rate": 0.25})
        assert scrape(port)["kinetix_train_solve_rate", ""] == 0.25
