"""The glossary of the pages is that of docs/glossary.md, and has every term that a page names."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import pytest

from kinetix_dist.studio.server.responses import STATIC
from tests.helpers import REPOSITORY

MAKER: dict[str, Any] = runpy.run_path(str(REPOSITORY / ".ci" / "web" / "glossary.py"))
PAGE = (REPOSITORY / "docs" / "glossary.md").read_text()
NAMES = {name for term in MAKER["glossary"](PAGE).values() for name in term["names"]}
NAMED = re.compile(r"\$\{Term\} name=\"([^\"]+)\"|\bterm: \"([^\"]+)\"")
SCRIPTS = [file for file in sorted(STATIC.rglob("*.js")) if NAMED.search(file.read_text())]


def test_the_pages_have_the_glossary_of_the_docs() -> None:
    assert (REPOSITORY / MAKER["TARGET"]).read_text() == MAKER["script"](PAGE), "run `make glossary`"


def test_every_row_of_the_page_is_a_term_in_plain_text() -> None:
    terms = MAKER["glossary"](PAGE)
    assert len(terms) == len(re.findall(r"^\| <a id", PAGE, re.MULTILINE))
    assert terms["clip-fraction"]["names"] == ["clip fraction", "clipped share"]
    assert all(not re.search(r"[`\[\]]|\(#", term["text"]) for term in terms.values())


def test_a_name_has_one_meaning() -> None:
    names = [name for term in MAKER["glossary"](PAGE).values() for name in term["names"]]
    assert len(names) == len(set(names))


@pytest.mark.parametrize("file", SCRIPTS, ids=lambda file: file.name)
def test_terms_that_a_script_names_are_in_the_glossary(file: Path) -> None:
    named = {one or other for one, other in NAMED.findall(file.read_text())}
    assert named <= NAMES
