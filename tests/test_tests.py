"""The tests' own order: they mirror the source folders, share by named helpers, and use public names."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

TESTS = Path(__file__).parent
ROOT = TESTS.parent
MODULES = sorted(TESTS.rglob("*.py"))
ELSEWHERE = {"viewer": "app/langsplat_viewer", "docs": "docs"}  # every other folder is of langsplat_core


@cache
def nodes(source: str) -> list[ast.AST]:
    return list(ast.walk(ast.parse(source)))


def imports(source: str) -> Iterator[tuple[str, str]]:
    """(module, name) of every import; the name is empty where a module is imported as a whole."""
    for node in nodes(source):
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from ((node.module or "", alias.name) for alias in node.names)


def other_tests(source: str) -> list[str]:
    """The test modules that a source imports from."""
    return [
        f"{module}.{name}"
        for module, name in imports(source)
        if module.startswith("tests") and any(part.startswith("test_") for part in [*module.split("."), name])
    ]


def private_names(source: str) -> list[str]:
    """Private names that a source imports, or replaces by their spelling; ruff's SLF001 finds the others."""
    found = [f"{module}.{name}" for module, name in imports(source) if is_private(name)]
    for node in nodes(source):
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("setattr"):
            texts = [part.value for part in node.args if isinstance(part, ast.Constant)]
            found += [t for t in texts if isinstance(t, str) and is_private(t.split(".")[-1])]
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def counterpart(folder: Path) -> Path:
    """The source folder that the tests in `folder` are about."""
    inside = folder.relative_to(TESTS).as_posix()
    return ROOT / ELSEWHERE.get(inside, f"langsplat_core/{inside}")


def test_no_test_module_imports_another() -> None:
    assert {path.name: found for path in MODULES if (found := other_tests(path.read_text()))} == {}


def test_no_private_name_is_imported_or_replaced() -> None:
    assert {path.name: found for path in MODULES if (found := private_names(path.read_text()))} == {}


def test_every_folder_of_tests_has_its_source_folder() -> None:
    folders = {path.parent for path in MODULES if path.name.startswith("test_")}
    assert len(folders) > 10
    assert [str(folder) for folder in folders if not counterpart(folder).is_dir()] == []


def test_the_rules_themselves_can_fail() -> None:
    assert other_tests("from tests.query.test_engine import two_blob_scene")
    assert other_tests("import tests.query.test_engine")
    assert other_tests("from tests.query import test_engine")
    assert not other_tests("from tests.support.scenes import random_camera")
    assert private_names("from langsplat_core.arrays import _hidden")
    assert private_names("monkeypatch.setattr(ply, '_rows', None)")
    assert private_names("patch.setattr('langsplat_core.formats.ply._rows', None)")
    assert not private_names("monkeypatch.setattr(ply, 'CHUNK_ROWS', 3)")
    assert not counterpart(TESTS / "nonsense").is_dir()
