"""Who may import whom. The layers stand in README.md under "Where things are"; this is the rule itself."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

# A module may import layers to the right of its own, and its own package; siblings in one layer never see each other.
LAYERS = (
    ("__main__",),
    ("cli",),
    ("benchmarks", "finetune", "server", "sweep"),
    ("recipes",),
    ("runtime",),
    ("dashboard", "play"),
    ("editor",),  # below play, whose worker answers what the editor asks
    ("config",),
    ("actors", "learner", "curator", "evaluation"),
    ("messages",),
    ("models",),
    ("env",),
    ("level",),
    ("telemetry", "checkpoint"),
    ("child_python", "jax_arithmetic", "jax_settings", "prng", "registry", "setting", "text_files", "user_directories"),
    ("engine_package", "errors", "installation", "near_names", "renamed_settings"),
)
LAYER_OF = {part: number for number, parts in enumerate(LAYERS) for part in parts}
# Rooms of runtime/, and which of the others each may import.
ROOMS = {"driver": {"cores", "processes"}, "cores": set(), "processes": set()}
RAY_ALLOWED = ("kinetix_dist/runtime/processes/", "kinetix_dist/cli/doctor_probes.py")
SOURCES = sorted([*REPOSITORY.glob("jax2d/**/*.py"), *REPOSITORY.glob("kinetix_dist/**/*.py")])


def imports(file: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, anywhere in it but under `if TYPE_CHECKING`."""
    package = file.relative_to(REPOSITORY).with_suffix("").parts[:-1]
    stack: list[ast.AST] = [ast.parse(file.read_text(), str(file))]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            continue
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


def room_of(module: str) -> str | None:
    """The room of runtime/ a module belongs to."""
    names = module.split(".")
    return names[2] if names[:2] == ["kinetix_dist", "runtime"] and len(names) > 2 else None


def imported_files(file: Path, modules: set[str]) -> set[str]:
    """Of `modules`, those that a file imports; `from package import module` imports the module, not the package."""
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


@pytest.mark.parametrize("file", SOURCES, ids=name_of)
def test_a_module_imports_lower_layers_only(file: Path) -> None:
    own = part_of(module_of(file))
    if own is None:
        pytest.skip("not in a layer")
    assert own in LAYER_OF, f"kinetix_dist/{own} is in no layer; put it into LAYERS and the README"
    for module in imports(file):
        other = part_of(module)
        if other is None or other == own or other not in LAYER_OF:
            continue
        assert LAYER_OF[other] > LAYER_OF[own], f"{name_of(file)} imports {module}: {own} may not import {other}"


@pytest.mark.parametrize("file", [f for f in SOURCES if room_of(module_of(f))], ids=name_of)
def test_rooms_of_the_runtime_see_what_they_may(file: Path) -> None:
    own = room_of(module_of(file))
    assert own in ROOMS, f"{name_of(file)} is in no room of runtime/; put it into one of {', '.join(ROOMS)}"
    for module in imports(file):
        other = room_of(module)
        assert other in {None, own, *ROOMS[own]}, f"{name_of(file)} imports {module}: {own} may not import {other}"


def test_no_file_of_the_runtime_lies_outside_its_rooms() -> None:
    assert [file.name for file in REPOSITORY.glob("kinetix_dist/runtime/*.py")] == ["__init__.py"]


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
