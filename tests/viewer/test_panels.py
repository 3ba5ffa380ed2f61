"""Panels change nothing by themselves: what they are told goes through `actions`."""

import ast
from pathlib import Path

from langsplat_viewer import panels

SOURCES = sorted(Path(panels.__path__[0]).glob("*.py"))


def is_state(node: ast.expr) -> bool:
    """`state`, `viewer.state`, `anything.state`, or something inside one."""
    match node:
        case ast.Name(id="state") | ast.Attribute(attr="state"):
            return True
        case ast.Attribute(value=inner) | ast.Subscript(value=inner):
            return is_state(inner)
        case _:
            return False


def targets(node: ast.AST) -> list[ast.expr]:
    """What a statement assigns to or deletes, tuples taken apart."""
    match node:
        case ast.Assign(targets=found) | ast.Delete(targets=found):
            pass
        case ast.AugAssign(target=one) | ast.AnnAssign(target=one) | ast.NamedExpr(target=one):
            found = [one]
        case ast.Call(func=ast.Name(id="setattr" | "delattr"), args=[one, *_]):
            return [ast.Attribute(one, "?")]
        case _:
            return []
    return [part for target in found for part in ast.walk(target) if isinstance(part, ast.expr)]


def writes(source: str) -> list[int]:
    """Lines that change the viewer's state."""
    found = []
    for node in ast.walk(ast.parse(source)):
        for target in targets(node):
            if isinstance(target, ast.Attribute | ast.Subscript) and is_state(target.value):
                found.append(getattr(node, "lineno", 0))
    return sorted(set(found))


def test_panels_write_no_state():
    assert len(SOURCES) > 6
    found = [f"{path.name}:{line}" for path in SOURCES for line in writes(path.read_text())]
    assert not found


def test_the_rule_itself_can_fail():
    for bad in (
        "viewer.state.typed = ''",
        "state.show_help, x = True, 1",
        "_, state.coarse_while_moving = f()",
        "state.picture.dim += 1",
        "state.queries[0].slot = None",
        "del viewer.state.view",
        "setattr(state, 'typed', '')",
    ):
        assert writes(bad) == [1], bad
    assert writes("state = viewer.state; typed = state.typed; x.y = state.typed") == []
