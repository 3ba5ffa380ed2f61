"""A table with mugs, their handles and a book, of Gaussians whose meanings are known at every level."""

from dataclasses import dataclass
from difflib import get_close_matches

import numpy as np

from langsplat_core.arrays import Array, logit, unit
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    Camera,
    LanguageField,
    LinearCodec,
    Reading,
    Scene,
    look_at,
)
from tests.support.fakes import everyday_about
from tests.support.scenes import unturned_gaussians

DIM = 8
AXES = ("mug", "handle", "book", "table", "red", "blue", "anything", "white")  # the seventh is canonical
COLOURS = ("red", "blue", "white")
TEMPERATURE = 2.0  # so that half as much likeness is visibly less, as published
SPREAD = 0.3  # of everyday phrases about the canonical one: half as much likeness is another thing
UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Block:
    """A box filled with Gaussians on a grid."""

    name: str
    centre: tuple[float, float, float]  # world units
    half: tuple[float, float, float]
    thing: str  # what it means as a whole
    part: str = ""  # and as a part of that; "": the same


BLOCKS = (
    Block("table", (0, 0, -0.1), (2.0, 1.0, 0.05), "table"),
    Block("red mug", (-1.0, 0, 0.2), (0.25, 0.25, 0.24), "red mug"),
    Block("red handle", (-0.6, 0, 0.2), (0.12, 0.08, 0.12), "red mug", "handle"),
    Block("blue mug", (1.2, 0, 0.15), (0.2, 0.2, 0.19), "blue mug"),
    Block("blue handle", (1.5, 0, 0.15), (0.1, 0.08, 0.1), "blue mug", "handle"),
    Block("book", (-0.3, 0.5, 0.0), (0.25, 0.2, 0.04), "book"),
    Block("far mug", (0, 0, -3.0), (0.4, 0.4, 0.4), "white mug"),
)
STEP = 0.06


def meaning(text: str) -> Array:
    """(DIM,) unit vector of a text of `AXES`; a colour says more than a thing, or all mugs would be red."""
    axes = [np.eye(DIM)[AXES.index(word)] for word in text.split()]
    return unit(np.sum(axes, 0)).astype(np.float32)


class PlainEncoder:
    """Knows `AXES`."""

    def encode_texts(self, texts: list[str]) -> Array:
        return np.stack(
            [np.eye(DIM, dtype=np.float32)[6] if t in CANONICAL_PHRASES else meaning(t) for t in texts]
        )

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return tuple(word for word in text.split() if word not in AXES)

    def near_words(self, word: str) -> tuple[str, ...]:
        return tuple(get_close_matches(word, AXES))


def laid_table(phrasebook: dict[str, Array] | None = None) -> tuple[Scene, dict[str, Array]]:
    """The scene, and (N,) bool of every block by its name. z is up, and the camera looks along +y."""
    points, owner = [], []
    for number, block in enumerate(BLOCKS):
        sides = [np.arange(-half, half + STEP / 2, STEP) for half in block.half]
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
        points.append(grid + np.array(block.centre))
        owner += [number] * len(grid)
    means, owners = np.concatenate(points), np.array(owner)
    count = len(means)
    gaussians = unturned_gaussians(means, np.log(0.04), logit(np.array(0.9)))
    wholes = np.stack([meaning(block.thing) for block in BLOCKS])[owners]
    parts = np.stack([meaning(block.part or block.thing) for block in BLOCKS])[owners]
    latents = np.stack([np.zeros_like(wholes), parts, wholes])
    confidence = np.ones((3, count), np.float32)
    confidence[0] = 0  # no subparts were outlined
    canonical = np.tile(np.eye(DIM, dtype=np.float32)[6], (4, 1))
    field = LanguageField(
        latents, confidence, LinearCodec(np.eye(DIM, dtype=np.float32)), canonical, "plain", phrasebook or {},
        Reading(temperature=TEMPERATURE), everyday=everyday_about(np.eye(DIM)[6], SPREAD),
    )  # fmt: skip
    masks = {block.name: owners == number for number, block in enumerate(BLOCKS)}
    return Scene(gaussians, field, (front_camera(),)), masks


def front_camera() -> Camera:
    """From in front of the table, looking along +y: x is to the right."""
    return look_at(np.array([0.0, -6.0, 0.5]), np.zeros(3), UP, (160, 120))
