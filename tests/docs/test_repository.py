"""Promises of the repository to a fresh clone: commands that exist, a lock that fits, no addresses in it."""

from __future__ import annotations

import importlib
import json
import re
import shlex
import subprocess
import tomllib
from pathlib import Path

import pytest

from kinetix_dist.checkpoint.store import pretrained_names
from kinetix_dist.cli.main import COMMANDS, parse_args
from tests.helpers import PATIENCE_S, REPOSITORY

README = (REPOSITORY / "README.md").read_text()
MAKEFILE = (REPOSITORY / "Makefile").read_text()
LOCK = (REPOSITORY / "requirements.lock").read_text()
TEXT_SUFFIXES = {"", ".py", ".toml", ".lock", ".txt", ".md", ".yaml", ".yml", ".sh", ".sbatch", ".cfg"}
DOCUMENTS = sorted([REPOSITORY / "README.md", *REPOSITORY.glob("docs/**/*.md"), *REPOSITORY.glob("cluster/**/*.md")])


def is_ours(path: Path) -> bool:
    """Below no folder with a dot, such as the environments of peers, nor where runs are."""
    folders = path.relative_to(REPOSITORY).parts
    return folders[0] != "runs" and not any(part.startswith(".") for part in folders)


MARKDOWN = sorted(filter(is_ours, [*REPOSITORY.glob("*.md"), *REPOSITORY.glob("[a-z]*/**/*.md")]))


@pytest.mark.parametrize("document", MARKDOWN, ids=lambda path: path.relative_to(REPOSITORY).as_posix())
def test_documents_wrap_below_120_columns(document: Path) -> None:
    """Rows of tables and fenced blocks cannot be wrapped."""
    text = re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL)
    assert not [line for line in text.splitlines() if len(line) >= 120 and not line.startswith("|")]


def test_readme_is_short() -> None:
    lines = README.splitlines()
    cells = [cell.strip() for line in lines if line.startswith("|") for cell in line.strip("|").split(" | ")]
    assert len(lines) <= 120
    assert not [cell for cell in cells if len(re.sub(r"\]\([^)]*\)", "]", cell)) >= 150]  # addresses are not read


def shell_lines(text: str) -> list[str]:
    """Commands in the fenced shell blocks of a Markdown text, without comments and continuation lines joined."""
    blocks = re.findall(r"```(?:sh|bash|console)\n(.*?)```", text, re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.split("  #")[0].strip() for line in lines if line.strip() and not line.strip().startswith("#")]


def commands(program: str) -> list[tuple[str, str]]:
    """(document, command line) of every use of a program in the documents."""
    found = []
    for document in DOCUMENTS:
        for line in shell_lines(document.read_text()):
            words = line.removeprefix("$ ").removeprefix(".venv/bin/")
            if words.startswith(program + " "):
                found.append((document.relative_to(REPOSITORY).as_posix(), words))
    return found


@pytest.fixture
def a_run_to_resume(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working directory with the run that the documents speak of: parsing `--resume` reads its configuration, and
    `--from` its newest checkpoint, in whose place any policy will do."""
    from kinetix_dist.config import to_dict
    from kinetix_dist.recipes import recipe

    run = tmp_path / "runs" / "quickstart"
    run.mkdir(parents=True)
    (run / "config.json").write_text(json.dumps({"config": to_dict(recipe("quickstart"))}))
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "00000104").symlink_to(REPOSITORY / "pretrained" / "generalist")
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("a_run_to_resume")
@pytest.mark.parametrize(("document", "line"), commands("kinetix-dist"))
def test_every_documented_command_parses(document: str, line: str) -> None:
    name, *arguments = shlex.split(line, comments=True)[1:]
    assert name in COMMANDS, f"{document}: {line}"
    module = importlib.import_module(COMMANDS[name][0])
    parse = getattr(module, "parse", None)
    if parse is not None:
        parse(arguments)
    else:
        parse_args(module.Args, arguments, prog=f"kinetix-dist {name}")


# Those of results, of the log and of changes are of their own time.
OF_TODAY = [
    path
    for pattern in ("*.md", "docs/*.md", "bench/*", "pretrained/*.md", "kinetix_dist/**/*.py")
    for path in REPOSITORY.glob(pattern)
    if path.suffix in (".md", ".py") and path.name not in ("CHANGELOG.md", "lab_log.md")
]
PLAYERS = {*pretrained_names(), "random", "noop", "keys"}


def test_every_pretrained_policy_that_a_command_names_exists() -> None:
    """A policy that is named without a path: `--from generalist`, in commands of documents and docstrings."""
    command = re.compile(r"^ *(?:kinetix-dist|python -m) .*", re.MULTILINE)
    option = re.compile(r"--(?:checkpoint|from|policy|policies) ([a-z][a-z0-9_]*)(?![\w/.])")
    named = {
        (path.name, name)
        for path in OF_TODAY
        for line in command.findall(path.read_text())
        for name in option.findall(line)
    }
    assert {"README.md", "levels.md"} <= {file for file, _ in named}
    assert {(file, name) for file, name in named if name not in PLAYERS} == set()


@pytest.mark.parametrize(("document", "line"), commands("make"))
def test_every_documented_make_target_exists(document: str, line: str) -> None:
    target = shlex.split(line, comments=True)[1]
    assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE), f"{document}: {line}"


def test_the_readme_names_the_two_commands() -> None:
    assert {"make train", "make test"} <= {line for _, line in commands("make")}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda d: d.relative_to(REPOSITORY).as_posix())
def test_links_to_files_lead_somewhere(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", document.read_text()):
        if "://" not in target:
            assert (document.parent / target).exists(), f"{document.name} links to {target}"


def test_continuous_integration_runs_make_test() -> None:
    assert re.search(r"^make test\nexec make test-long$", (REPOSITORY / ".ci" / "run").read_text(), re.MULTILINE)


def test_the_lock_has_hashes_and_no_addresses() -> None:
    assert "://" not in LOCK
    pins = re.findall(r"^([a-z0-9][a-z0-9._-]*)==", LOCK, re.MULTILINE)
    assert pins
    for entry in re.split(r"\n(?=[a-z0-9])", LOCK.strip()):
        assert "--hash=sha256:" in entry, entry.splitlines()[0]


def test_the_lock_satisfies_pyproject() -> None:
    """Renew it with `make lock` where this fails."""
    from packaging.requirements import Requirement
    from packaging.version import Version

    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = project["dependencies"] + extras["dev"] + extras["wrappers"]
    locked: dict[str, list[Version]] = {}
    for name, version in re.findall(r"^([a-z0-9][a-z0-9._-]*)==(\S+)", LOCK, re.MULTILINE):
        locked.setdefault(name, []).append(Version(version))
    for requirement in map(Requirement, wanted):
        name = requirement.name.lower().replace("_", "-")
        assert name in locked, f"{name} is not in requirements.lock"
        for version in locked[name]:
            assert requirement.specifier.contains(version), f"{name}: {version} is locked, {requirement} wanted"


def test_no_file_names_a_package_registry() -> None:
    """Whoever installs chooses the registry; a file that names one would override that choice."""
    hosts = ["pypi" + ".org", "python" + "hosted.org", "conda" + ".anaconda", "registry." + "npmjs"]
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=PATIENCE_S
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.split("\0")):
        file = REPOSITORY / name
        if file.is_file() and file.suffix in {
            "",
            ".py",
            ".toml",
            ".lock",
            ".txt",
            ".md",
            ".yaml",
            ".yml",
            ".sh",
            ".cfg",
        }:
            text = file.read_text(errors="ignore")
            assert not [host for host in hosts if host in text], f"{name} names a package registry"
