"""Damaged checkpoints of other methods: read, or refused in one line."""

from pathlib import Path

import numpy as np
import pytest
import torch

from langsplat_core.extensions.checkpoints.methods import read_foreign
from tests.support.file_kinds import drawable_share
from tests.support.file_samples import autoencoder, save_model, tensor
from tests.support.mutation import FileKind, fuzz
from tests.support.scenes import random_gaussians

SCENE = random_gaussians(20, sh_degree=1)


def checkpoints(folder: Path) -> list[bytes]:
    """Of Occam's LGS, and without features."""
    vectors = np.random.default_rng(0).normal(size=(20, 24)).astype(np.float32)
    paths = [save_model(folder / "made", SCENE, tensor(vectors)), save_model(folder / "plain", SCENE)]
    return [path.read_bytes() for path in paths]


def autoencoders(folder: Path) -> list[bytes]:
    """Of LangSplat; the checkpoint that goes with it lies beside."""
    save_model(folder / "latents_1.pth", SCENE, tensor(np.ones((20, 3), np.float32)))
    torch.save(autoencoder(24, (8, 3), (5,)).state_dict(), folder / "made")
    return [(folder / "made").read_bytes()]


def imported(path: Path) -> float:
    beside = path.with_name("latents_1.pth")
    scene = read_foreign([path, *[beside] * beside.exists()])
    for level in (level for level in range(3) if scene.levels[level] is not None):
        scene.rows(level, np.arange(len(scene.scene.gaussians)))
    return drawable_share(scene.scene.gaussians)


KINDS = {name: FileKind("a.pth", made, imported) for name, made in
         (("checkpoint", checkpoints), ("autoencoder", autoencoders))}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("name", KINDS)
def test_a_few_mutants_are_read_or_refused(tmp_path: Path, name: str) -> None:
    fuzz(KINDS[name], tmp_path, 60, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("name", KINDS)
def test_many_mutants_are_read_or_refused(tmp_path: Path, name: str, seed: int) -> None:
    fuzz(KINDS[name], tmp_path, 3000, seed)
