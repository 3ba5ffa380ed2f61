"""Patches in place of masks, and the table of the paper's comparisons."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import unit
from langsplat_core.errors import InputError
from langsplat_core.lab.config import PaperBenchConfig
from langsplat_core.lab.rooms import paper_tables as module
from langsplat_core.lab.rooms.paper_tables import OURS, PATCHES, PaperRow, measure_paper, paper_table, ways
from langsplat_core.lab.rooms.patches import (
    SCALES,
    PatchField,
    among_gaussians,
    lift_patches,
    patch_vectors,
    pictures,
)
from langsplat_core.lab.rooms.report import Measured
from langsplat_core.lab.rooms.scoring import DirectScore, Score
from langsplat_core.lab.rooms.tiles import SIDES, TileMasks
from langsplat_core.progress import silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.semantics.masks import label_maps
from langsplat_core.semantics.relevancy import relevancy
from tests.support.scenes import random_camera, random_gaussians


class MeanColour:
    """An encoder whose vector is the mean colour of a picture."""

    id, image_size = "colour", 8

    def encode_images(self, crops):
        return unit(np.asarray(crops, np.float64).mean(axis=(1, 2)) + 1).astype(np.float32)


def two_halves(height: int = 60, width: int = 80):
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = 255
    image[:, width // 2 :, 2] = 255
    return image


@pytest.mark.parametrize("scale", [0.05, 0.3, 1.0, 3.0])
def test_patches_say_what_is_near(scale):
    vectors = patch_vectors(two_halves(), MeanColour(), scale)
    assert vectors.shape == (60, 80, 3)
    assert vectors.dtype == np.float32
    if scale < 1:  # far from the border between the halves the patches hold one colour
        np.testing.assert_allclose(
            vectors[:, 2], unit(np.array([256.0, 1, 1]))[None].repeat(60, 0), atol=1e-4
        )
        np.testing.assert_allclose(
            vectors[:, -2], unit(np.array([1, 1, 256.0]))[None].repeat(60, 0), atol=1e-4
        )
        middle = vectors[30, :, 0]
        assert (np.diff(middle) <= 1e-6).all()  # interpolated in between, not torn


def test_lifted_patches_are_the_mean_of_what_pixels_say():
    """Against W^T y of the reference rows, one channel at a time."""
    gaussians, camera = random_gaussians(40), random_camera(width=80, height=60)
    lifted = lift_patches(CpuRasterizer(), gaussians, [(camera, two_halves())], MeanColour())
    assert lifted.shape == (len(SCALES), 40, 3)
    view = CpuRasterizer().view(gaussians, camera)
    for row in (0, len(SCALES) - 1):
        plain = view.gather(patch_vectors(two_halves(), MeanColour(), SCALES[row]))
        seen = np.linalg.norm(plain, axis=1) > 1e-3
        np.testing.assert_allclose(lifted[row, seen], unit(plain[seen]), atol=1e-5)


def test_the_best_scale_is_the_one_with_the_highest_peak():
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(3, 50, 6))).astype(np.float32)
    vectors[1, 7] = 0
    canonical = unit(rng.normal(size=(2, 6))).astype(np.float32)
    field = PatchField(vectors, canonical, 10.0)
    phrase = vectors[1, 9]
    found = among_gaussians(field, phrase[None])[0]
    want = relevancy(vectors[1], phrase[None], canonical)[:, 0]
    want[7] = 0
    np.testing.assert_allclose(found, want, atol=1e-6)
    gaussians, camera = random_gaussians(50), random_camera(width=32, height=24)
    view = CpuRasterizer().view(gaussians, camera)
    single = [pictures(replace(field, vectors=vectors[[scale]]), view, phrase[None])[0] for scale in range(3)]
    best = max(single, key=lambda shown: shown.max())
    np.testing.assert_array_equal(pictures(field, view, phrase[None])[0], best)


@pytest.mark.parametrize("size", [(48, 64), (50, 33), (1, 1)])
def test_tiles_cover_the_picture_once(size):
    levels = TileMasks()(np.zeros((*size, 3), np.uint8), silent)
    for masks, share in zip(levels.masks, SIDES, strict=True):
        assert (masks.sum(axis=0) == 1).all()
        assert masks.any(axis=(1, 2)).all()
        assert max(mask.any(axis=0).sum() for mask in masks) <= max(round(share * size[0]), 1)
    assert (label_maps(levels) >= 0).all()


def row(name: str, seed: int, share: float, **changes: object) -> PaperRow:
    scores = (Score("object", 10, share, 0.9), Score("part", 30, share / 2, 0.5))
    made = Measured(
        scores=scores, direct=(DirectScore("object", 5, 0.25),), accepted=0, objects=0, rejected=0, absent=0,
        separation=1, peaks={}, unknown=(), query_ms=30.0, name=name, query="blend answers", frame_ms=12.0,
    )  # fmt: skip
    return PaperRow(seed, replace(made, **changes))


def test_the_table_has_means_and_spreads():
    rows = [row(OURS, 1, 0.8), row(OURS, 2, 0.6), row("the paper", 1, 0.4, query="paper")]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in paper_table(rows).splitlines()]
    assert [line[0] for line in lines[2:]] == [OURS, "the paper"]
    assert lines[2][1] == "70.0 / 90.0 / 25.0 +/- 14.1"
    assert lines[2][4].startswith("43.8 / 60.0")  # (10 * 0.7 + 30 * 0.35) / 40
    assert [line[5] for line in lines[2:]] == ["42", "12"]  # the paper's picture is its answer
    assert row(PATCHES, 1, 0.5).picture_ms == 12


def test_the_picture_is_drawn(tmp_path):
    rows = [row(OURS, 1, 0.8), row(OURS, 2, 0.6), row(PATCHES, 1, 0.4)]
    module.plot(rows, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as drawn:
        assert drawn.width > 900
        assert np.asarray(drawn.convert("L")).std() > 5


def test_every_way_has_its_own_name_and_settings():
    made = ways(PaperBenchConfig(), 512)
    assert len({variant.name for variant in made}) == len(made)
    assert [v.codec.latent_dim for v in made if "in one pass" in v.name] == [1, 2, 3, 8]
    assert [v.level for v in made if "alone" in v.name] == ["subpart", "part", "whole"]


def test_mistakes(tmp_path):
    with pytest.raises(InputError, match="--seeds"):
        measure_paper(PaperBenchConfig(seeds=()), tmp_path)
    with pytest.raises(InputError, match="--only nothing: no row has that; the rows are LERF's way"):
        measure_paper(PaperBenchConfig(only=("nothing",)), tmp_path)
    assert not list(tmp_path.iterdir())


def test_rows_are_kept(tmp_path, monkeypatch):
    made = []

    class FakeRoom:
        def __init__(self, config, tier, seed, *_):
            self.config, self.seed, self.weights = config, seed, "w"

        def measure(self, variant):
            made.append((self.seed, variant.name))
            return row(variant.name, self.seed, 0.5, masks=variant.masks).measured

    monkeypatch.setattr(module, "Room", FakeRoom)
    config = PaperBenchConfig(seeds=(1, 2), only=("level",))
    first = measure_paper(config, tmp_path, kept=tmp_path / "rows.jsonl")
    again = measure_paper(config, tmp_path, kept=tmp_path / "rows.jsonl")
    assert len(made) == 6
    assert again == first
