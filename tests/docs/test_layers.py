"""Which package may import which: the layers of the table in docs/architecture.md."""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from kinetix_dist import runtime
from tests.helpers import REPOSITORY

PAGE = REPOSITORY / "docs" / "architecture.md"
HEADER = ["| package | duty |", "|---|---|"]
ROW = re.compile(r"\| (`\w+`(?:, `\w+`)*) \| [^|]*\w[^|]* \|")


def layers_of(page: str) -> list[tuple[str, ...]]:
    """Return the packages of each row of the page's table, from the top. Raise ValueError for a malformed table."""
    lines = page.splitlines()
    starts = [number for number in range(len(lines)) if lines[number : number + 2] == HEADER]
    if len(starts) != 1:
        raise ValueError(f"{PAGE.name} has {len(starts)} tables of packages; it needs exactly one, headed {HEADER[0]}")
    rows = list(itertools.takewhile(lambda line: line.startswith("|"), lines[starts[0] + 2 :]))
    layers = []
    for row in rows:
        match = ROW.fullmatch(row)
        if match is None:
            raise ValueError(f"{PAGE.name}: the row {row!r} must be | `package`, `package` | duty |")
        layers.append(tuple(re.findall(r"\w+", match[1])))
    names = [name for layer in layers for name in layer]
    if not names:
        raise ValueError(f"{PAGE.name}: the table of packages has no rows")
    if repeated := {name for name in names if names.count(name) > 1}:
        raise ValueError(f"{PAGE.name}: {', '.join(sorted(repeated))} must be in one row only")
    return layers


# A package may import the packages of the rows below its own, and itself; packages of one row never import each other.
LAYER_OF = {name: number for number, layer in enumerate(layers_of(PAGE.read_text())) for name in layer}
# Subpackages of packages that have them, and which of the others each may import.
SUBPACKAGES = {
    "runtime": {"driver": {"cores", "processes"}, "cores": set(), "processes": set()},
    "studio": {"server": {"runs", "worker"}, "runs": set(), "worker": set()},
}
RAY_ALLOWED = ("kinetix_dist/runtime/processes/", "kinetix_dist/cli/doctor_probes.py")
SOURCES = sorted([*REPOSITORY.glob("jax2d/**/*.py"), *REPOSITORY.glob("kinetix_dist/**/*.py")])


def imports(file: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, anywhere in it and for types alone, too."""
    package = file.relative_to(REPOSITORY).with_suffix("").parts[:-1]
    stack: list[ast.AST] = [ast.parse(file.read_text(), str(file))]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, [base, node.module or ""]))
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)  # which may be a module too
        stack.extend(ast.iter_child_nodes(node))


def name_of(file: Path) -> str:
    return file.relative_to(REPOSITORY).as_posix()


def module_of(file: Path) -> str:
    """Dotted name; that of the package for its `__init__.py`."""
    parts = file.relative_to(REPOSITORY).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def part_of(module: str) -> str | None:
    """The part of kinetix_dist a module belongs to: "env" for kinetix_dist.env.reward."""
    names = module.split(".")
    return names[1] if names[0] == "kinetix_dist" and len(names) > 1 else None


def subpackage_of(module: str) -> tuple[str, str] | None:
    """Package and subpackage that a module belongs to: ("studio", "runs") for kinetix_dist.studio.runs.series."""
    top, package, own, *_ = [*module.split("."), "", "", ""]
    return (package, own) if top == "kinetix_dist" and package in SUBPACKAGES and own else None


def imported_files(file: Path, modules: set[str]) -> set[str]:
    """Members of `modules` that a file imports; `from package import module` imports the module, not the package."""
    names = set(imports(file)) & modules
    return {name for name in names if not any(other.startswith(f"{name}.") for other in names)}


def circles(graph: Mapping[str, set[str]]) -> set[frozenset[str]]:
    """Sets of nodes that all reach each other, of two nodes or more."""
    reached = {}
    for start in graph:
        seen, stack = set(), [start]
        while stack:
            for neighbour in graph.get(stack.pop(), set()) - seen:
                seen.add(neighbour)
                stack.append(neighbour)
        reached[start] = seen
    groups = {frozenset(other for other in reached[node] if node in reached.get(other, ())) for node in graph}
    return {group for group in groups if len(group) > 1}


def test_the_table_names_all_packages_and_nothing_else() -> None:
    entries = (REPOSITORY / "kinetix_dist").iterdir()
    names = {path.stem for path in entries if path.suffix == ".py" or (path / "__init__.py").is_file()} - {"__init__"}
    assert set(LAYER_OF) == names


@pytest.mark.parametrize(
    ("rows", "problem"),
    [
        (["| `a` | duty |", "| b | duty |"], "must be"),
        (["| `a`, b | duty |"], "must be"),
        (["| `a` `b` | duty |"], "must be"),
        (["| `a` | |"], "must be"),
        (["| `a` |"], "must be"),
        (["| `a` | duty | more |"], "must be"),
        (["| `a`, `b` | duty |", "| `a` | duty |"], "a must be in one row only"),
        ([], "has no rows"),
        (["", *HEADER, "| `a` | duty |"], "has 2 tables"),
    ],
)
def test_a_malformed_table_is_rejected(rows: list[str], problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        layers_of("\n".join([*HEADER, *rows]))


def test_a_page_without_a_table_is_rejected() -> None:
    with pytest.raises(ValueError, match="has 0 tables"):
        layers_of("| `a` | duty |")


def test_rows_of_a_table_are_layers_in_their_order() -> None:
    page = "\n".join(["Text", *HEADER, "| `b`, `a` | two |", "| `c` | one |", "", "| `d` | of another table |"])
    assert layers_of(page) == [("b", "a"), ("c",)]


@pytest.mark.parametrize("file", SOURCES, ids=name_of)
def test_a_module_imports_lower_layers_only(file: Path) -> None:
    own = part_of(module_of(file))
    if own is None:
        pytest.skip("not in a layer")
    assert own in LAYER_OF, f"kinetix_dist/{own} is in no row of the table of {PAGE.name}; add it there"
    for module in imports(file):
        other = part_of(module)
        if other is None or other == own or other not in LAYER_OF:
            continue
        assert LAYER_OF[other] > LAYER_OF[own], f"{name_of(file)} imports {module}: {own} may not import {other}"


@pytest.mark.parametrize("file", [f for f in SOURCES if subpackage_of(module_of(f))], ids=name_of)
def test_a_subpackage_imports_those_that_it_may(file: Path) -> None:
    package, own = subpackage_of(module_of(file)) or ("", "")
    allowed = SUBPACKAGES[package]
    assert own in allowed, f"{name_of(file)} is in no subpackage of {package}/; put it into one of {', '.join(allowed)}"
    for module in imports(file):
        of_package, other = subpackage_of(module) or ("", "")
        may_see = of_package != package or other in {own, *allowed[own]}
        assert may_see, f"{name_of(file)} imports {module}: {own} may not import {other}"


@pytest.mark.parametrize("package", SUBPACKAGES)
def test_no_file_lies_outside_the_subpackages(package: str) -> None:
    assert [file.name for file in REPOSITORY.glob(f"kinetix_dist/{package}/*.py")] == ["__init__.py"]


def test_other_packages_import_the_public_names_of_the_runtime_alone() -> None:
    def is_inner(module: str) -> bool:
        return (subpackage_of(module) or ("", ""))[1] in SUBPACKAGES["runtime"]

    found = [
        f"{name_of(file)} imports {module}"
        for file in SOURCES
        if part_of(module_of(file)) != "runtime"
        for module in imports(file)
        if is_inner(module)
    ]
    assert not found, "; ".join(found)
    for name in runtime.__all__:
        assert getattr(runtime, name) is not None, name
    assert set(runtime.__all__) == set(runtime._MODULE_OF)


@pytest.mark.parametrize("package", ["kinetix_dist", "jax2d"])
def test_no_circle_of_imports_among_files(package: str) -> None:
    files = {module_of(file): file for file in SOURCES if name_of(file).startswith(f"{package}/")}
    graph = {name: imported_files(file, set(files)) - {name} for name, file in files.items()}
    assert sum(map(len, graph.values())) >= len(files) // 2, "hardly any import was found: is the graph right?"
    found = circles(graph)
    assert not found, "files import each other in a circle: " + "; ".join(" <-> ".join(sorted(c)) for c in found)


def test_circles_are_found() -> None:
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": {"a"}}
    assert circles(graph) == {frozenset({"b", "c"})}


@pytest.mark.parametrize("file", [f for f in SOURCES if name_of(f).startswith("jax2d/")], ids=name_of)
def test_the_engine_knows_nothing_of_training(file: Path) -> None:
    assert not [module for module in imports(file) if module.split(".")[0] == "kinetix_dist"]


@pytest.mark.parametrize("file", SOURCES, ids=name_of)
def test_warp_and_ray_are_imported_only_where_they_are_used(file: Path) -> None:
    name = name_of(file)
    tops = {module.split(".")[0] for module in imports(file)}
    if "warp" in tops:
        assert name.startswith("jax2d/warp/"), f"{name} imports warp, which only jax2d/warp may"
    if "ray" in tops:
        assert name.startswith(RAY_ALLOWED), f"{name} imports ray, which only {' and '.join(RAY_ALLOWED)} may"
