"""The outline of a scene: its tree in words, each thing with its parts."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.query.describe import Describer
from langsplat_core.query.instances import oriented_box
from langsplat_core.query.word_scores import OR, Word, likely_name
from langsplat_core.scene import NO_NODE

LEAST_SHARE = 5e-4  # of the scene's surface that a node must have to be listed
LEAST_COUNT = 12  # Gaussians that it must have
NAMES = 3  # words, at most, that a node is called by


@dataclass(frozen=True, eq=False)
class Outline:
    """A node of the scene's tree in words, with its parts."""

    node: int  # number in the tree
    level: int  # index into LEVELS
    word: Word | None  # the best name; None where nothing of the vocabulary is likely
    count: int  # Gaussians
    share: float  # of the scene's surface, in [0, 1]
    centre: Array  # (3,) world units
    size: Array  # (3,) sides of the oriented box, longest first, world units
    votes: tuple[int, int]  # photographs with a mask of just this, and those that show it without one
    parts: tuple["Outline", ...]  # the largest first


def scene_outline(describer: Describer, least: float = LEAST_SHARE) -> tuple[Outline, ...]:
    """Return the scene's tree, wholes with the largest surface first.

    Left out are nodes of less than `least` of the scene's surface, and parts that say nothing new: without a
    word, or with that of what they are in; their own parts take their place.
    """
    tree, members, areas = describer.engine.tree, describer.engine.tree.gaussians(), describer.areas
    every = max(float(areas.sum()), 1e-300)
    totals = np.array([areas[rows].sum() for rows in members]) / every
    large = [node for node, rows in enumerate(members) if totals[node] >= least and len(rows) >= LEAST_COUNT]
    large.sort(key=lambda node: -totals[node])
    parts: dict[int, list[int]] = {}
    for node in large:
        parts.setdefault(int(tree.parents[node]), []).append(node)

    def name_of(node: int) -> Word | None:
        rows, level = members[node], int(tree.levels[node])
        weights = np.maximum(areas[rows], 1e-300)
        return likely_name(describer.at_level(level, rows, weights, NAMES).words)

    def below(node: int, word: Word | None) -> Iterator[Outline]:
        for part in parts.get(node, []):
            own = name_of(part)
            if own is None or (word is not None and own.phrase.split(OR)[0] in word.phrase.split(OR)):
                yield from below(part, word)
            else:
                yield shown(part, own)

    def shown(node: int, word: Word | None) -> Outline:
        rows = members[node]
        weights = np.maximum(areas[rows], 1e-300)
        positions = describer.engine.scene.gaussians.means[rows].astype(np.float64)
        return Outline(
            node=node,
            level=int(tree.levels[node]),
            word=word,
            count=len(rows),
            share=float(totals[node]),
            centre=weights @ positions / weights.sum(),
            size=2 * oriented_box(positions).half_extents,
            votes=(int(tree.votes[node, 0]), int(tree.votes[node, 1])),
            parts=tuple(sorted(below(node, word), key=lambda part: -part.share)),
        )

    return tuple(shown(node, name_of(node)) for node in parts.get(NO_NODE, []))
