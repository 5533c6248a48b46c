"""Addresses that hold for one file and ten minutes."""

from __future__ import annotations

import pytest

from kinetix_dist.studio.server.tickets import HOLDS_SECONDS, Tickets


def test_a_ticket_holds_for_its_name_and_its_time() -> None:
    tickets = Tickets()
    ticket = tickets.ticket("a.rrd", now=1000.0)
    assert tickets.is_good(ticket, "a.rrd", now=1000.0 + HOLDS_SECONDS - 1)
    assert not tickets.is_good(ticket, "a.rrd", now=1000.0 + HOLDS_SECONDS)
    assert not tickets.is_good(ticket, "b.rrd", now=1000.0)
    assert not Tickets().is_good(ticket, "a.rrd", now=1000.0), "the key is new with every start"


@pytest.mark.parametrize("ticket", ["", "-", "9999999999-", "x-y", "²-a", "99999999999999999999-a", "9999999999"])
def test_what_is_no_ticket_is_refused(ticket: str) -> None:
    assert not Tickets().is_good(ticket, "a.rrd", now=0.0)


def test_a_later_time_needs_another_ticket() -> None:
    tickets = Tickets()
    until, _, code = tickets.ticket("a.rrd", now=1000.0).partition("-")
    assert not tickets.is_good(f"{int(until) + 1}-{code}", "a.rrd", now=1000.0)
