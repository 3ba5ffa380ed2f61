"""What a phrase with structure says, as a tree of the phrases in it, and its reading for people."""

from dataclasses import dataclass
from typing import Literal, get_args

Side = Literal["on", "in", "near", "left of", "right of", "above", "below", "behind", "in front of"]
SIDES: tuple[Side, ...] = get_args(Side)
Extreme = Literal["biggest", "smallest", "nearest", "farthest", "highest", "lowest", "leftmost", "rightmost"]
EXTREMES: tuple[Extreme, ...] = get_args(Extreme)


@dataclass(frozen=True)
class Atom:
    """A phrase that is asked whole."""

    text: str


@dataclass(frozen=True)
class Inside:
    """A part, looked for on the whole alone."""

    part: "Tree"
    whole: "Tree"


@dataclass(frozen=True)
class Relation:
    """Those of `what` that stand so to one of `anchor`."""

    kind: Side
    what: "Tree"
    anchor: "Tree"


@dataclass(frozen=True)
class Both:
    """All of them, each to be there."""

    items: tuple["Tree", ...]


@dataclass(frozen=True)
class Union:
    """Whichever of them is there."""

    items: tuple["Tree", ...]


@dataclass(frozen=True)
class Without:
    """What is `what` and not `unwanted`."""

    what: "Tree"
    unwanted: "Tree"


@dataclass(frozen=True)
class Superlative:
    """The one of `what` that is most so; "nearest" and "farthest" are seen from `anchor`, else the viewer."""

    kind: Extreme
    what: "Tree"
    anchor: "Tree | None" = None


Tree = Atom | Inside | Relation | Both | Union | Without | Superlative


def atoms(tree: Tree) -> tuple[Atom, ...]:
    """The phrases of a tree, in the order in which they are written."""
    if isinstance(tree, Atom):
        return (tree,)
    return tuple(atom for child in children(tree) for atom in atoms(child))


def reading(tree: Tree) -> str:  # noqa: PLR0911  one row of a table each
    """How a tree was understood, such as "handle  inside  red mug"; groups in a group stand in brackets."""
    match tree:
        case Atom(text):
            return text
        case Both(items):
            return "  and  ".join(map(_nested, items))
        case Union(items):
            return "  or  ".join(map(_nested, items))
        case Without(what, unwanted):
            return f"{_nested(what)}  without  {_nested(unwanted)}"
        case Inside(part, whole):
            return f"{_nested(part)}  inside  {_nested(whole)}"
        case Relation(kind, what, anchor):
            return f"{_nested(what)}  {kind}  {_nested(anchor)}"
        case Superlative(kind, what, anchor):
            seen_from = "" if anchor is None else f"  from  {_nested(anchor)}"
            return f"{kind}  {_nested(what)}{seen_from}"


def _nested(tree: Tree) -> str:
    return tree.text if isinstance(tree, Atom) else f"({reading(tree)})"


def children(tree: Tree) -> tuple[Tree, ...]:
    """What a tree is made of."""
    match tree:
        case Both(items) | Union(items):
            return items
        case Inside(one, other) | Without(one, other) | Relation(_, one, other):
            return (one, other)
        case Superlative(_, what, anchor):
            return (what,) if anchor is None else (what, anchor)
        case Atom():
            return ()
