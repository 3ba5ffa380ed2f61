"""The layers are a rule: imports run strictly downward, and opening a scene loads nothing heavy."""

import ast
import graphlib
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# From top to bottom; packages of one row never import each other.
LAYERS = [
    ["tests"],
    ["assets.making"],
    ["langsplat_viewer.__main__"],
    ["langsplat_viewer.window"],
    ["langsplat_viewer.panels"],
    ["langsplat_viewer.canvas"],
    ["langsplat_viewer.commands"],
    ["langsplat_viewer.actions"],
    ["langsplat_viewer.output"],
    ["langsplat_viewer.options"],
    ["langsplat_viewer.viewer"],
    ["langsplat_viewer.state"],
    ["langsplat_viewer.files"],
    ["langsplat_viewer.rendering"],
    ["langsplat_viewer.marks"],
    ["langsplat_viewer.camera"],
    ["langsplat_viewer.jobs", "langsplat_viewer.fonts"],
    ["langsplat_core.__main__"],
    ["langsplat_core.cli"],
    ["langsplat_core.bench"],
    ["langsplat_core.pipeline"],
    ["langsplat_core.evaluation", "langsplat_core.compaction"],
    ["langsplat_core.training.radiance", "langsplat_core.training.language", "langsplat_core.query"],
    [
        "langsplat_core.raster",
        "langsplat_core.display",
        "langsplat_core.semantics",
        "langsplat_core.datasets",
    ],
    ["langsplat_core.io"],
    ["langsplat_core.scene"],
    ["langsplat_core.config", "langsplat_core.compiled"],
    ["langsplat_core.arrays", "langsplat_core.progress"],
    ["langsplat_core.errors"],
]
FACADE = "langsplat_core.__init__"  # the public names; it may reach anything below the command line
HEAVY = ("torch", "open3d", "transformers", "pycolmap", "moderngl", "glfw", "imgui_bundle", "skimage")


def module_name(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[1:] if parts[0] == "app" else parts)


def package_of(module: str) -> str | None:
    for row in LAYERS:
        for package in row:
            if module == package or module.startswith(package + "."):
                return package
    return None


def rank(package: str) -> int:
    return next(i for i, row in enumerate(LAYERS) if package in row)


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


def imported_modules(path: Path) -> list[str]:
    names = []
    for node in ast.walk(parsed(path)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names.append(node.module or "")
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


def violations(module: str, imports: list[str]) -> list[str]:
    own = package_of(module)
    found = []
    for name in imports:
        other = package_of(name)
        if own is None or other is None or other == own:
            continue
        if rank(other) <= rank(own):
            found.append(f"{module} imports {name}")
    return found


SOURCES = [
    path
    for folder in ("tests/benchmarks", "assets/making", "langsplat_core", "app")
    for path in ROOT.glob(f"{folder}/**/*.py")
    if not path.name.startswith("test_")
]


def test_imports_run_strictly_downward():
    assert len(SOURCES) > 20
    found = []
    for path in SOURCES:
        if module_name(path) != FACADE:
            found += violations(module_name(path), imported_modules(path))
    assert not found, "\n".join(found)


def names_imported(path: Path, lazily_too: bool) -> list[str]:
    """Full names that a file imports, when it is imported itself or also inside functions; what only type
    checkers see does not count."""
    names = []
    waiting: list[ast.AST] = list(parsed(path).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            waiting += node.orelse
        elif lazily_too or not isinstance(node, (ast.FunctionDef, ast.Lambda)):
            waiting += ast.iter_child_nodes(node)
    return names


def import_graph(imports: dict[str, list[str]]) -> dict[str, set[str]]:
    """Module -> modules it imports, both of the project; a name in a module counts as that module."""
    graph = {}
    for module, names in imports.items():
        known = {name if name in imports else name.rpartition(".")[0] for name in names}
        graph[module] = {name for name in known if name in imports and name != module}
    return graph


def circle_in(graph: dict[str, set[str]]) -> list[str]:
    """Modules that import each other in a circle; empty where there is none."""
    try:
        list(graphlib.TopologicalSorter(graph).static_order())
    except graphlib.CycleError as error:
        return list(error.args[1])
    return []


@pytest.mark.parametrize("lazily_too", [False, True])
def test_no_files_import_each_other_in_a_circle(lazily_too: bool) -> None:
    files = {module_name(path).removesuffix(".__init__"): path for path in SOURCES}
    del files[FACADE.removesuffix(".__init__")]
    graph = import_graph({name: names_imported(path, lazily_too) for name, path in files.items()})
    assert circle_in(graph) == []


def test_a_circle_would_be_found():
    assert circle_in(import_graph({"a": ["b.name"], "b": ["c"], "c": ["a"]}))
    assert not circle_in(import_graph({"a": ["b", "c"], "b": ["c"], "c": ["numpy"]}))


def test_every_module_has_a_layer():
    homeless = [
        module_name(path)
        for path in SOURCES
        if package_of(module_name(path)) is None
        and module_name(path) not in (FACADE, "langsplat_core.training.__init__", "langsplat_viewer.__init__")
    ]
    assert not homeless


def test_the_rule_itself_can_fail():
    assert violations("langsplat_core.scene.camera", ["langsplat_core.query.engine"])
    assert violations("langsplat_core.training.language.lift", ["langsplat_core.query"])
    assert not violations("langsplat_core.training.language.lift", ["langsplat_core.raster.protocol"])


def test_opening_a_scene_imports_nothing_heavy():
    code = (
        "import sys, langsplat_core, langsplat_core.io.scenes, langsplat_core.scene,"
        " langsplat_core.query.engine,"
        " langsplat_core.display.displays, langsplat_core.raster;"
        f"print([m for m in {HEAVY!r} if m in sys.modules])"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
