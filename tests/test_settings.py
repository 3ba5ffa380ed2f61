"""Every setting works: each field of a configuration is read somewhere by the code that is given it.

The sources are read, not run. An expression's configuration class is known from annotations (of parameters,
fields and module constants), from `self.x = parameter`, from local assignments and from `replace(...)`.
"""

import ast
import dataclasses
import re
import typing
from pathlib import Path

import pytest

from langsplat_core import bench, config
from langsplat_core.config import Range, Setting

ROOT = Path(__file__).parent.parent
SOURCES = [*ROOT.glob("langsplat_core/**/*.py"), *ROOT.glob("app/**/*.py")]
CONFIGS = {
    name: value
    for module in (config, bench)
    for name, value in vars(module).items()
    if dataclasses.is_dataclass(value) and isinstance(value, type) and value not in (Range, Setting)
}
FIELDS = {
    name: {key: getattr(kind, "__name__", "") for key, kind in typing.get_type_hints(cls).items()}
    for name, cls in CONFIGS.items()
}
CONSTANTS = {
    name: type(value).__name__ for name, value in vars(config).items() if type(value).__name__ in FIELDS
}


KNOWN = dict(FIELDS)  # and, once the sources are read, classes that hold a configuration in a field


def class_named(annotation: ast.expr | None) -> str:
    """The known class that an annotation mentions, "" for none."""
    words = "" if annotation is None else re.findall(r"\w+", ast.unparse(annotation))
    return next((word for word in words if word in KNOWN), "")


def remember_holders(tree: ast.AST) -> None:
    """Note the classes of a source that hold a configuration in an annotated field."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name not in FIELDS:
            parts = [p for p in node.body if isinstance(p, ast.AnnAssign) and isinstance(p.target, ast.Name)]
            held = {ast.unparse(part.target): class_named(part.annotation) for part in parts}
            if any(held.values()):
                KNOWN[node.name] = held


class Reader(ast.NodeVisitor):
    """Collects (class, field) of every field that is read."""

    def __init__(self) -> None:
        self.read: set[tuple[str, str]] = set()
        self.names: dict[str, str] = dict(CONSTANTS)
        self.own: dict[str, str] = {}  # attributes of self

    def kind(self, node: ast.expr) -> str:
        """The known class of an expression, "" for anything else."""
        match node:
            case ast.Name():
                found = self.names.get(node.id, "")
            case ast.Attribute(value=ast.Name(id="self")) if node.attr in self.own:
                found = self.own[node.attr]
            case ast.Attribute():
                found = KNOWN.get(self.kind(node.value), {}).get(node.attr, "")
            case ast.Call(func=ast.Name(id="replace"), args=[first, *_]):
                found = self.kind(first)
            case ast.Call(func=ast.Name(id=name)):
                found = name if name in KNOWN else ""
            case ast.BoolOp(values=choices):
                found = next((kind for choice in choices if (kind := self.kind(choice))), "")
            case ast.IfExp():
                found = self.kind(node.body) or self.kind(node.orelse)
            case _:
                found = ""
        return found

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        outer, self.own = self.own, {}
        for part in node.body:
            if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                self.own[part.target.id] = class_named(part.annotation)
        bodies = [part for part in node.body if isinstance(part, ast.FunctionDef)]
        for part in sorted(bodies, key=lambda body: body.name != "__init__"):  # it says what self holds
            self.visit(part)
        self.own = outer

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        outer, self.names = self.names, dict(self.names)
        for argument in (*node.args.args, *node.args.kwonlyargs):
            self.names[argument.arg] = class_named(argument.annotation)
        self.generic_visit(node)
        self.names = outer

    def visit_Assign(self, node: ast.Assign) -> None:
        self.generic_visit(node)
        for target in node.targets:
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for place, value in pairs:
                if isinstance(place, ast.Name):
                    self.names[place.id] = self.kind(value)
                elif isinstance(place, ast.Attribute) and ast.unparse(place.value) == "self":
                    self.own[place.attr] = self.kind(value)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        self.generic_visit(node)
        if isinstance(node.target, ast.Name):
            self.names[node.target.id] = class_named(node.annotation)

    def visit_Attribute(self, node: ast.Attribute) -> None:
        kind = self.kind(node.value)
        if isinstance(node.ctx, ast.Load) and node.attr in FIELDS.get(kind, {}):
            self.read.add((kind, node.attr))
        self.generic_visit(node)


def fields_read(sources: dict[str, str]) -> set[tuple[str, str]]:
    trees = [ast.parse(text) for text in sources.values()]
    for tree in trees:
        remember_holders(tree)
    reader = Reader()
    for tree in trees:
        reader.visit(tree)
    return reader.read


@pytest.fixture(scope="module")
def read() -> set[tuple[str, str]]:
    return fields_read({str(path): path.read_text() for path in SOURCES if path.name != "config.py"})


@pytest.mark.parametrize("name", sorted(FIELDS))
def test_every_setting_is_read(name: str, read: set[tuple[str, str]]) -> None:
    assert [field for field in FIELDS[name] if (name, field) not in read] == []


def test_a_setting_that_nothing_reads_is_found():
    used = "def load(config: ClipConfig):\n    return config.model, config.device\n"
    other = (
        "class Fit:\n"
        "    def __init__(self, config: CodecConfig):\n        self.config = config\n"
        "    def run(self): return self.config.batch\n"
    )
    found = fields_read({"used": used, "other": other})
    assert ("ClipConfig", "model") in found
    assert ("CodecConfig", "batch") in found
    assert ("ClipConfig", "batch") not in found  # another class's field of the same name
