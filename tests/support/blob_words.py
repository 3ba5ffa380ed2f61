"""The scene of three blobs, its meanings as a codebook, and phrases for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from langsplat_core.scene import LanguageField, Scene
from langsplat_core.scene.codec import CodebookCodec
from tests.support.fakes import DIM, WORDS, axis, blobs, cameras, language

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


def named_scene(codebook: bool = True, path: Path | None = None) -> Scene:
    return Scene(blobs(), named_field(codebook), cameras(), path)
