"""Answers to queries as displays take them, and a scene with a random language field."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import LanguageField, LinearCodec, Scene
from tests.support.scenes import random_gaussians, random_values


@dataclass(frozen=True, eq=False)
class Answer:
    """The part of a query's result that displays show."""

    relevancy: Array  # (3, N)
    members: Array  # (N,) bool
    level: int = 2
    verdict: Literal["found", "weak match", "not here"] = "found"
    heat_range: tuple[float, float] = (0.5, 0.9)


def random_answer(count: int, seed: int, **changed) -> Answer:
    relevancy = np.stack([random_values(count, 1, seed + level)[:, 0] for level in range(3)])
    return Answer(relevancy, relevancy[2] > 0.5, **changed)


def random_scene(count: int = 150, sh_degree: int = 3) -> Scene:
    """Random Gaussians, each with random latents of 3 numbers."""
    latents = np.random.default_rng(count).normal(size=(3, count, 3)).astype(np.float32)
    axes = np.eye(12, dtype=np.float32)
    field = LanguageField(latents, np.ones((3, count), np.float32), LinearCodec(axes[:3]), axes[:4], "none")
    return Scene(random_gaussians(count, sh_degree=sh_degree), field)
