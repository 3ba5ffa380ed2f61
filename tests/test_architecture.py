"""The layers are a rule: imports run strictly downward, and opening a scene loads nothing heavy."""

import ast
import graphlib
import subprocess
import sys
from collections import Counter
from functools import cache
from itertools import chain
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
# From top to bottom; packages of one row never import each other.
LAYERS = [
    ["tests"],
    ["assets.making"],
    ["langsplat_viewer.__main__"],
    ["langsplat_viewer.program"],
    ["langsplat_viewer.window"],
    ["langsplat_viewer.panels"],
    ["langsplat_viewer.canvas"],
    ["langsplat_viewer.commands"],
    ["langsplat_viewer.actions"],
    ["langsplat_viewer.output"],
    ["langsplat_viewer.options"],
    ["langsplat_viewer.viewer"],
    ["langsplat_viewer.state"],
    ["langsplat_viewer.disk"],
    ["langsplat_viewer.projects"],
    ["langsplat_viewer.session"],
    ["langsplat_viewer.rendering"],
    ["langsplat_viewer.marks"],
    ["langsplat_viewer.camera"],
    ["langsplat_viewer.jobs"],
    ["langsplat_core.__main__"],
    ["langsplat_core.cli"],
    ["langsplat_core.pipeline"],
    ["langsplat_core.display"],
    ["langsplat_core.training.radiance", "langsplat_core.training.language", "langsplat_core.query"],
    [f"langsplat_core.{package}" for package in ("raster", "semantics", "datasets")],
    ["langsplat_core.io"],
    ["langsplat_core.scene"],
    ["langsplat_core.config", "langsplat_core.compiled"],
    ["langsplat_core.arrays", "langsplat_core.progress"],
    ["langsplat_core.registry"],
    ["langsplat_core.errors", "langsplat_core.interrupts"],
]
# Beside the layers: they see public names of the core, which sees none.
EXTENSIONS = "langsplat_core.extensions"
FACADE = "langsplat_core.__init__"  # the public names; it may reach anything below the command line
HEAVY = ["torch", "open3d", "transformers", "pycolmap", "skimage", "matplotlib"]
OF_WINDOW = ["moderngl", "glfw", "imgui_bundle"]  # heavy too


def module_name(path: Path) -> str:
    parts = list(path.relative_to(ROOT).with_suffix("").parts)
    return ".".join(parts[1:] if parts[0] == "app" else parts)


def package_of(module: str) -> str | None:
    return next((one for one in chain(*LAYERS) if f"{module}.".startswith(f"{one}.")), None)


def rank(package: str) -> int:
    return next(i for i, row in enumerate(LAYERS) if package in row)


@cache
def imported_modules(path: Path, types_too: bool) -> list[str]:
    """Modules, and names in them, that a file imports, also inside functions; types_too: for checkers."""
    names = []
    waiting: list[ast.AST] = list(ast.parse(path.read_text()).body)
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test) and not types_too:
            waiting += node.orelse
        else:
            waiting += ast.iter_child_nodes(node)
    return names


def violations(module: str, imports: list[str]) -> list[str]:
    own = package_of(module)
    others = [(name, package_of(name)) for name in imports]
    return [
        f"{module} imports {name}"
        for name, other in others
        if own is not None and other not in (None, own) and rank(other) <= rank(own)
    ]


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
            found += violations(module_name(path), imported_modules(path, types_too=True))
    assert not found, "\n".join(found)


def test_core_never_imports_an_extension() -> None:
    files = [path for path in SOURCES if not module_name(path).startswith((EXTENSIONS, "assets.", "tests."))]
    found = [
        f"{module_name(path)} imports {name}"
        for path in files
        for name in imported_modules(path, types_too=True)
        if f"{name}.".startswith(f"{EXTENSIONS}.")
    ]
    assert not found, "\n".join(found)


def test_extensions_use_public_names_and_their_own() -> None:
    """An extension may build on another one, where it says so in its imports, but on no private name."""
    found = [
        f"{module_name(path)} imports {name}"
        for path in (ROOT / "langsplat_core" / "extensions").rglob("*.py")
        for name in imported_modules(path, types_too=True)
        if name.startswith("langsplat_")
        and any(part.startswith("_") for part in name.split("."))
        and not name.endswith(".__version__")
    ]
    assert not found, "\n".join(found)


def test_imports_form_no_circle() -> None:
    files = {module_name(path).removesuffix(".__init__"): path for path in SOURCES}
    del files[FACADE.removesuffix(".__init__")]
    graph = {}
    for module, path in files.items():
        names = imported_modules(path, types_too=False)
        known = {name if name in files else name.rpartition(".")[0] for name in names}
        graph[module] = known & set(files) - {module}
    graphlib.TopologicalSorter(graph).prepare()  # CycleError names the modules


def test_public_classes_have_names_of_their_own() -> None:
    product = [path for path in SOURCES if path.relative_to(ROOT).parts[0] in ("langsplat_core", "app")]
    classes = [node.name for path in product for node in ast.parse(path.read_text()).body
               if isinstance(node, ast.ClassDef) and not node.name.startswith("_")]  # fmt: skip
    assert [name for name, count in Counter(classes).items() if count > 1] == []


def test_every_module_has_a_layer():
    modules = {module_name(path) for path in SOURCES if not module_name(path).startswith(EXTENSIONS)}
    homeless = {module for module in modules if package_of(module) is None}
    assert homeless <= {FACADE, "langsplat_core.training.__init__", "langsplat_viewer.__init__"}


def test_texts_are_read_and_written_in_a_stated_encoding() -> None:
    """What is not stated is code page 1252 or another on Windows."""
    found = []
    for path in SOURCES:
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and getattr(call.func, "attr", "") in ("read_text", "write_text"):
                stated = any(word.arg == "encoding" for word in call.keywords)
                found += [] if stated else [f"{path}:{call.lineno}"]
    assert found == []


CORE = "core, core.io.scenes, core.scene, core.query.engine, core.display.displays, core.raster"


@pytest.mark.parametrize("modules", [CORE.replace("core", "langsplat_core"), "langsplat_viewer.window"])
def test_opening_a_scene_imports_nothing_heavy(modules):
    heavy = HEAVY if "viewer" in modules else HEAVY + OF_WINDOW
    code = f"import sys, {modules}; print([name for name in {heavy!r} if name in sys.modules])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "[]"
