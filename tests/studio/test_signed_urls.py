"""Signed URLs are valid for one file and ten minutes."""

from __future__ import annotations

import pytest

from kinetix_dist.studio.server.access import VALID_SECONDS, UrlSigner


def test_a_signature_is_valid_for_its_name_and_its_time() -> None:
    signer = UrlSigner()
    signature = signer.sign("a.rrd", now=1000.0)
    assert signer.is_valid(signature, "a.rrd", now=1000.0 + VALID_SECONDS - 1)
    assert not signer.is_valid(signature, "a.rrd", now=1000.0 + VALID_SECONDS)
    assert not signer.is_valid(signature, "b.rrd", now=1000.0)
    assert not UrlSigner().is_valid(signature, "a.rrd", now=1000.0), "the key is new with every start"


@pytest.mark.parametrize("signature", ["", "-", "9999999999-", "x-y", "²-a", "99999999999999999999-a", "9999999999"])
def test_what_is_no_signature_is_refused(signature: str) -> None:
    assert not UrlSigner().is_valid(signature, "a.rrd", now=0.0)


def test_a_later_time_needs_another_signature() -> None:
    signer = UrlSigner()
    until, _, code = signer.sign("a.rrd", now=1000.0).partition("-")
    assert not signer.is_valid(f"{int(until) + 1}-{code}", "a.rrd", now=1000.0)
