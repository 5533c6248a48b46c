"""The libraries of the pages are the files that were listed, with their licences."""

from __future__ import annotations

import hashlib
import json

from kinetix_dist.studio.server.responses import STATIC
from tests.helpers import REPOSITORY

VENDOR = STATIC / "vendor"
LISTED = json.loads((VENDOR / "vendored.json").read_text())


def test_every_file_is_what_was_listed() -> None:
    for name, about in LISTED.items():
        assert hashlib.sha256((VENDOR / name).read_bytes()).hexdigest() == about["sha256"], f"{name}: run `make vendor`"


def test_nothing_else_lies_there_but_our_own_types() -> None:
    ours = {"vendored.json", "htm_preact.d.ts"}
    assert {file.name for file in VENDOR.iterdir()} == set(LISTED) | ours


def test_versions_are_those_of_the_packages_that_are_fetched_and_licences_are_there() -> None:
    wanted = json.loads((REPOSITORY / ".ci" / "web" / "package.json").read_text())["dependencies"]
    for name, about in LISTED.items():
        assert about["version"] == wanted[about["package"]], name
        assert about["licence"] in ("MIT", "Apache-2.0")
    assert {name.split(".")[0] for name in LISTED if "LICENSE" in name} == {"uPlot", "htm_preact"}


def test_the_lock_of_the_npm_packages_has_hashes_and_no_addresses() -> None:
    text = (REPOSITORY / ".ci" / "web" / "package-lock.json").read_text()
    packages = json.loads(text)["packages"]
    assert "://" not in text
    assert all("integrity" in about for name, about in packages.items() if name)
