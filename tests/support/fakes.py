"""Scenes with known language features, blobs and a laid table, and text encoders that know their words."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, logit, unit
from langsplat_core.config import annotations, named_values
from langsplat_core.io.scenes import save_scene
from langsplat_core.pipeline.report import REPORT, work_folder
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import (
    CANONICAL_PHRASES,
    Calibration,
    Camera,
    Gaussians,
    LanguageField,
    LinearCodec,
    PlattScaling,
    Scene,
    look_at,
)
from langsplat_core.scene.codec import CodebookCodec
from langsplat_core.semantics.features import FeatureStore, ImageFeatures
from tests.support.scenes import transforms, unturned_gaussians

COUNT = 64


def everyday_about(canonical: Array, spread: float = 0.2) -> Array:
    """Return (64, D) float32 unit vectors around a (D,) canonical phrase: nothing in particular fits them."""
    noise = np.random.default_rng(8).normal(scale=spread, size=(COUNT, len(canonical)))
    return unit(canonical + noise).astype(np.float32)


WORDS = ("mug", "book", "plant")  # each an axis of the vector space; the fourth is the canonical phrases'
CENTRES = np.array([[-1.2, 0.0, 0.0], [0.0, 0.0, 0.0], [1.2, 0.0, 0.0]])
COLOURS = np.array([[0.8, 0.2, 0.2], [0.2, 0.7, 0.2], [0.2, 0.3, 0.8]])
PER_BLOB = 120
DIM = 8


def axis(index: int) -> Array:
    return np.eye(DIM, dtype=np.float32)[index]


def blobs(seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    means = np.repeat(CENTRES, PER_BLOB, 0) + rng.normal(scale=0.18, size=(3 * PER_BLOB, 3))
    colours = (np.repeat(COLOURS, PER_BLOB, 0) - 0.5) / 0.2820948
    return unturned_gaussians(means, np.log(0.08), logit(np.array(0.85)), colours[:, None])


def language(phrasebook: bool = False) -> LanguageField:
    """Each blob means its word at level "whole"; at "part" all are a little "plant"; "subpart" is empty."""
    latents = np.zeros((3, 3 * PER_BLOB, 4), np.float32)
    latents[2] = np.repeat(np.eye(4, dtype=np.float32)[:3], PER_BLOB, 0)
    latents[1] = unit(0.6 * np.eye(4)[2] + 0.8 * np.eye(4)[3])
    confidence = np.ones((3, 3 * PER_BLOB), np.float32)
    confidence[0] = 0
    return LanguageField(
        latents=latents,
        confidence=confidence,
        codec=LinearCodec(np.eye(4, DIM, dtype=np.float32)),
        canonical=np.tile(axis(3), (4, 1)),
        encoder_id="fake",
        phrasebook={"book": axis(1)} if phrasebook else {},
        everyday=everyday_about(axis(3)),
    )


def cameras(count: int = 3) -> tuple[Camera, ...]:
    """Views from in front (-z) along an arc; y points down."""
    up = np.array([0.0, -1.0, 0.0])
    found = []
    for index in range(count):
        angle = 0.5 * (index - (count - 1) / 2)
        eye = 5 * np.array([np.sin(angle), -0.15, -np.cos(angle)])
        view = look_at(eye, np.zeros(3), up, (160, 120))
        found.append(Camera(160, 120, view.fx, view.fy, 80, 60, view.world_to_camera, f"photo_{index}"))
    return tuple(found)


def blob_scene(*, field: bool = True, with_cameras: bool = True, phrasebook: bool = False) -> Scene:
    words = language(phrasebook) if field else None
    return Scene(blobs(), words, cameras() if with_cameras else (), Path("blobs.ply"))


class FakeEncoder:
    words, canonical = WORDS, 3

    def encode_texts(self, texts: list[str]) -> Array:
        return np.stack([axis(self.canonical) if t in CANONICAL_PHRASES else self.vector(t) for t in texts])

    def vector(self, text: str) -> Array:
        return axis(WORDS.index(text))

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return tuple(word for word in text.split() if word not in self.words)

    def near_words(self, word: str) -> tuple[str, ...]:
        return tuple(get_close_matches(word, self.words))


class Fluent(FakeEncoder):
    """Knows every word, each by a direction of its own; the canonical phrases as they are given."""

    def __init__(self, canonical: Array) -> None:
        """Canonical: (4, D) unit."""
        self.given = dict(zip(CANONICAL_PHRASES, canonical, strict=True))

    def encode_texts(self, texts: list[str]) -> Array:
        return np.float32([self.given.get(text, self.vector(text)) for text in texts])

    def vector(self, text: str) -> Array:
        dim = len(self.given[CANONICAL_PHRASES[0]])
        return unit(np.random.default_rng(list(text.encode())).normal(size=dim))

    def unknown_words(self, text: str) -> tuple[str, ...]:
        return ()


def calibrated_for(phrase: str, logit_of_whole: float) -> Calibration:
    """With which `phrase`, asked of the blobs, has a probability of sigmoid(logit_of_whole)."""
    fits = QueryEngine(blob_scene(), lambda _: FakeEncoder()).run(phrase).fits
    return Calibration(*[PlattScaling(logit_of_whole - 8 * fits[2], whole=8.0, finer=0.0)] * 3)


NAMES = (*WORDS, "wall")  # "wall" is nowhere in the scene
BOOK = {**{word: axis(number) for number, word in enumerate(WORDS)}, "wall": axis(6)}


def named_field(codebook: bool = True) -> LanguageField:
    """Each blob means its word at level "whole"; `NAMES` are in the phrasebook, so no encoder is needed."""
    made = replace(language(), phrasebook=BOOK)
    if not codebook:
        return made
    codec = CodebookCodec(np.eye(4, DIM, dtype=np.float32), np.zeros((4, 3), np.float32))
    codes = made.codec.decode(made.latents.reshape(-1, 4)) @ codec.vectors.T
    return replace(made, codec=codec, latents=codes.argmax(1).astype(np.uint16).reshape(3, -1, 1))


def named_scene(codebook: bool = True) -> Scene:
    return Scene(blobs(), named_field(codebook), cameras())


def as_trained(path: Path, scene: Scene, features: Sequence[ImageFeatures]) -> None:
    """Save a scene with masks and report as a training leaves them, and grey photographs in "photographs"."""
    save_scene(path, scene)
    work, photographs = work_folder(path), path.parent / "photographs"
    photographs.mkdir()
    for camera, seen in zip(scene.cameras, features, strict=True):
        FeatureStore(work / "features").save(camera.name, seen)
        Image.new("RGB", (camera.width, camera.height), (90, 90, 90)).save(photographs / f"{camera.name}.png")
    files = [f"{camera.name}.png" for camera in scene.cameras]
    (photographs / "transforms.json").write_text(transforms(scene.cameras, files))
    (work / REPORT).write_text(json.dumps({"dataset": str(photographs)}))


# A table with mugs, their handles and a book, of Gaussians whose language features are known at every level.

AXES = ("mug", "handle", "book", "table", "red", "blue", "anything", "white")  # the seventh is canonical
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
    return unit(np.sum([np.eye(DIM)[AXES.index(word)] for word in text.split()], 0)).astype(np.float32)


class PlainEncoder(FakeEncoder):
    words, canonical = AXES, 6

    def vector(self, text: str) -> Array:
        return meaning(text)


def laid_table(phrasebook: dict[str, Array] | None = None) -> tuple[Scene, dict[str, Array]]:
    """The scene, and (N,) bool of every block by its name. z is up, and the camera looks along +y."""
    points, owner = [], []
    for number, block in enumerate(BLOCKS):
        sides = [np.arange(-half, half + STEP / 2, STEP) for half in block.half]
        grid = np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
        points.append(grid + np.array(block.centre))
        owner += [number] * len(grid)
    means, owners = np.concatenate(points), np.array(owner)
    gaussians = unturned_gaussians(means, np.log(0.04), logit(np.array(0.9)))
    wholes = np.stack([meaning(block.thing) for block in BLOCKS])[owners]
    parts = np.stack([meaning(block.part or block.thing) for block in BLOCKS])[owners]
    latents = np.stack([np.zeros_like(wholes), parts, wholes])
    confidence = np.ones((3, len(means)), np.float32)
    confidence[0] = 0  # no subparts were outlined
    field = LanguageField(
        latents, confidence, LinearCodec(np.eye(DIM, dtype=np.float32)), np.tile(axis(6), (4, 1)), "plain",
        phrasebook or {}, temperature=TEMPERATURE, everyday=everyday_about(np.eye(DIM)[6], SPREAD),
    )  # fmt: skip
    masks = {block.name: owners == number for number, block in enumerate(BLOCKS)}
    return Scene(gaussians, field, (front_camera(),)), masks


def front_camera() -> Camera:
    """From in front of the table, looking along +y: x is to the right."""
    return look_at(np.array([0.0, -6.0, 0.5]), np.zeros(3), UP, (160, 120))


def numeric_settings(settings: object) -> list[tuple[str, Any, Any]]:
    """Return option, value and type of the fields that hold numbers, as `config.named_values` has them."""
    return [one for one in named_values(settings) if any(k in (int, float) for k in annotations(one[2]))]
