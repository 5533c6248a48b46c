"""Runs in directories of any name: their rows, and the pages that the rows lead to."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.studio.runs_for_tests import write_run
from tests.studio.serving import Server


def test_a_run_of_any_name_has_a_row_and_pages(
    tmp_path: Path, open_page: Callable[..., Any], serve: Callable[..., Server]
) -> None:
    names = {b"run\xff": "run~ff", b"100%": "100~25", b"a%2Fb": "a~252Fb", b"a,b": "a~2cb", b'"q"': "~22q~22"}
    for name in names:
        write_run(tmp_path / os.fsdecode(name), 5)
    (tmp_path / "latest").symlink_to("100%")
    page = open_page(serve(tmp_path, "--no-play"))
    for shown in names.values():
        page.get_by_role("link", name=shown, exact=True).wait_for()
    assert page.locator("tbody tr").count() == len(names)
    for shown in names.values():
        page.get_by_role("link", name=shown, exact=True).click()
        page.locator(".facts").get_by_text("640 of").wait_for()  # 5 updates of 128 steps
        assert page.url.endswith(f"#/run/{shown}/overview")
        page.go_back()


def test_an_address_with_a_bare_percent_is_a_page(
    tmp_path: Path, open_page: Callable[..., Any], serve: Callable[..., Server]
) -> None:
    write_run(tmp_path / "a", 5)
    page = open_page(serve(tmp_path, "--no-play"), "#/run/100%/overview")
    page.get_by_text("there is no run '100%'").first.wait_for()
    assert not [text for text in page.complaints if "URI" in text]
    page.complaints.clear()  # the browser says that there is no such run
