"""The site of docs/: it builds without a warning and holds every page."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

DOCS = REPOSITORY / "docs"
ELSEWHERE = ("//fonts.", "//cdn.", "unpkg.com", "jsdelivr", "googleapis")  # sites must not fetch anything


@pytest.mark.long
@pytest.mark.skipif(importlib.util.find_spec("sphinx") is None, reason="needs the extra docs")
def test_the_site_builds_without_a_warning_and_fetches_nothing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "sphinx", "--fail-on-warning", "--keep-going", "--quiet", "--builder", "html"]
    command += ["--conf-dir", "docs", "--doctree-dir", str(tmp_path / "trees"), ".", str(tmp_path / "html")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=REPOSITORY, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    index = (tmp_path / "html/docs/index.html").read_text()
    assert "Glossary" in index and not [address for address in ELSEWHERE if address in index]
    assert "BatchedEnv.step" in (tmp_path / "html/docs/api.html").read_text()


def test_every_page_is_in_the_navigation() -> None:
    index = (DOCS / "index.md").read_text()
    listed = re.findall(
        r"^(?:.* <)?([\w./]+)>?$", "\n".join(re.findall(r"```\{toctree\}(.*?)```", index, re.DOTALL)), re.M
    )
    pages = {path.relative_to(DOCS).with_suffix("").as_posix() for path in DOCS.glob("**/*.md")} - {"index"}
    assert pages <= set(listed)


def test_there_are_twenty_terms_in_the_order_of_the_alphabet() -> None:
    terms = re.findall(r"^\| <a id=\"[\w-]+\"></a>(.*?) \|", (DOCS / "glossary.md").read_text(), re.MULTILINE)
    assert len(terms) >= 20 and terms == sorted(terms)
