"""Who may import whom. The layers stand in README.md under "Where things are"; this is the rule itself."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from tests.helpers import REPOSITORY

# A module may import layers to the right of its own, and its own package; siblings in one layer never see each other.
LAYERS = (
    ("cli",),
    ("benchmarks",),
    ("recipes",),
    ("runtime",),
    ("config",),
    ("actors", "learner", "curator", "evaluation", "editor", "dashboard"),
    ("messages",),
    ("models",),
    ("env",),
    ("level",),
    ("telemetry", "checkpoint", "process_shell"),
    ("errors", "installation"),
)
LAYER_OF = {part: number for number, parts in enumerate(LAYERS) for part in parts}
SOURCES = sorted([*REPOSITORY.glob("jax2d/**/*.py"), *REPOSITORY.glob("kinetix_dist/**/*.py")])


def imports(file: Path) -> Iterator[str]:
    """Full names of all modules that a file imports, anywhere in it but under `if TYPE_CHECKING`."""
    for module, names in import_statements(file):
        yield module
        if module == "kinetix_dist":  # `from kinetix_dist import config` imports a module
            yield from (f"{module}.{name}" for name in names)


def import_statements(file: Path) -> Iterator[tuple[str, list[str]]]:
    """(full name of a module, names imported from it) of the same imports; no names for `import module`."""
    package = file.relative_to(REPOSITORY).with_suffix("").parts[:-1]
    stack: list[ast.AST] = [ast.parse(file.read_text(), str(file))]
    while stack:
        node = stack.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            yield ".".join(filter(None, [base, node.module or ""])), [alias.name for alias in node.names]
        stack.extend(ast.iter_child_nodes(node))


def name_of(file: Path) -> str:
    return file.relative_to(REPOSITORY).as_posix()


def part_of(module: str) -> str | None:
    """The part of kinetix_dist a module belongs to: "env" for kinetix_dist.env.reward."""
    names = module.split(".")
    return names[1] if names[0] == "kinetix_dist" and len(names) > 1 else None


@pytest.mark.parametrize("file", SOURCES, ids=name_of)
def test_a_module_imports_lower_layers_only(file: Path) -> None:
    own = part_of(".".join(file.relative_to(REPOSITORY).with_suffix("").parts))
    if own is None or own == "__init__":
        pytest.skip("not in a layer")
    assert own in LAYER_OF, f"kinetix_dist/{own} is in no layer; put it into LAYERS and the README"
    for module in imports(file):
        other = part_of(module)
        if other is None or other == own or other not in LAYER_OF:
            continue
        assert LAYER_OF[other] > LAYER_OF[own], f"{name_of(file)} imports {module}: {own} may not import {other}"


# Parts in which no file may import itself through others.
WITHOUT_CIRCLES = {
    "cli": [f for f in SOURCES if name_of(f).startswith("kinetix_dist/cli/")],
    "benchmarks": [f for f in SOURCES if name_of(f).startswith("kinetix_dist/benchmarks/")],
    "jax2d": [f for f in SOURCES if name_of(f).startswith("jax2d/") and "/fidelity/" not in name_of(f)],
}


def module_of(file: Path) -> str:
    return name_of(file).removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def circle(graph: Mapping[str, set[str]]) -> list[str]:
    """Modules of which each imports the next and the last one the first; empty where there is no such circle."""
    done: set[str] = set()

    def search(module: str, path: list[str]) -> list[str]:
        if module in path:
            return path[path.index(module) :]
        if module in done:
            return []
        for other in sorted(graph.get(module, ())):
            if found := search(other, [*path, module]):
                return found
        done.add(module)
        return []

    return next(filter(None, (search(module, []) for module in graph)), [])


def imported_modules(file: Path, modules: set[str]) -> set[str]:
    """Of `modules`, those that a file imports; `from package import module` imports the module."""
    found: set[str] = set()
    for name, names in import_statements(file):
        submodules = {f"{name}.{alias}" for alias in names} & modules
        found |= submodules or ({name} & modules)
    return found


@pytest.mark.parametrize("part", WITHOUT_CIRCLES)
def test_no_file_imports_itself_through_others(part: str) -> None:
    files = {module_of(file): file for file in WITHOUT_CIRCLES[part]}
    graph = {module: imported_modules(file, set(files)) for module, file in files.items()}
    assert sum(map(len, graph.values())) >= len(files) // 2, "hardly any import was found: is the graph right?"
    assert not (found := circle(graph)), " -> ".join([*found, found[0]])


def test_a_circle_is_found() -> None:
    assert circle({"a": {"b"}, "b": {"c", "d"}, "c": set(), "d": {"b"}}) == ["b", "d"]
    assert circle({"a": {"b", "c"}, "b": {"c"}, "c": set()}) == []


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
        ray_allowed = name.startswith(("kinetix_dist/runtime/", "kinetix_dist/cli/")) or name.endswith("_actor.py")
        assert ray_allowed, f"{name} imports ray, which only *_actor.py, runtime/ and cli/ may"
