"""Masks that agree take the place of those that each photograph was given."""

import numpy as np
import pytest

from langsplat_core.pipeline.agreement import STAGE, agreed_features
from langsplat_core.progress import Progress, Report, WorkCancelledError, silent
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.raster.render import render
from langsplat_core.semantics.store import ImageFeatures
from langsplat_core.training.language.patch_maps import draw_patches
from tests.support.fakes import PER_BLOB, blob_scene, cameras


class MeanColour:
    """Stands in for CLIP: the mean colour of a crop."""

    id, image_size, crops = "mean colour", 8, 0

    def encode_images(self, crops: np.ndarray) -> np.ndarray:
        self.crops += len(crops) if len(crops) > 1 else 0  # one alone asks which encoder this is
        means = crops.reshape(len(crops), -1, 3).mean(1) + 1.0
        return (means / np.linalg.norm(means, axis=1, keepdims=True)).astype(np.float32)


@pytest.fixture(scope="module")
def room():
    """Gaussians, views whose masks split every blob somewhere else in every photograph, and photographs."""
    scene, rng = blob_scene(), np.random.default_rng(0)
    blob = (np.arange(len(scene.gaussians)) // PER_BLOB).astype(np.int32)
    views, photographs = [], []
    for camera in cameras():
        labels = draw_patches(CpuRasterizer().view(scene.gaussians, camera), scene.gaussians, blob)
        count, maps = int(blob.max()) + 1, []
        for level in range(3):
            halves = (np.arange(labels.shape[1]) > rng.integers(0, labels.shape[1])).astype(np.int32)
            split = labels + count * halves if level < 2 else labels
            maps.append(np.where(labels >= 0, split + 2 * count * level, -1))
        maps = np.stack(maps).astype(np.int32)
        views.append((camera, ImageFeatures(maps, np.zeros((6 * count, 0), np.float32))))
        photographs.append((np.round(255 * render(scene, camera).colours.clip(0, 1)).astype(np.uint8), None))
    return scene.gaussians, blob, views, photographs


def test_every_photograph_shows_the_things_of_the_scene(room, tmp_path):
    gaussians, blob, views, photographs = room
    features = agreed_features(
        *(gaussians, views, photographs, MeanColour(), CpuRasterizer()), tmp_path, silent
    )
    judged = 0
    for (camera, _), seen in zip(views, features, strict=True):
        whole = seen.labels[2]
        true = draw_patches(CpuRasterizer().view(gaussians, camera), gaussians, blob)
        for one in np.unique(true[true >= 0]):
            own = true == one
            if own.sum() < 20:
                continue
            judged += 1
            row = np.bincount(whole[own & (whole >= 0)]).argmax()
            assert (own & (whole == row)).sum() / (own | (whole == row)).sum() > 0.8
        assert sorted(np.unique(seen.labels[seen.labels >= 0])) == list(range(len(seen.vectors)))
    assert judged >= len(views)


def test_an_interrupted_run_goes_on_where_it_stopped(room, tmp_path):
    gaussians, _, views, photographs = room

    def stop(at: Report) -> None:
        if at.stage == STAGE and at.fraction >= 0.5:
            raise WorkCancelledError

    scene = gaussians, views, photographs
    first, second, whole = MeanColour(), MeanColour(), MeanColour()
    with pytest.raises(WorkCancelledError):
        agreed_features(*scene, first, CpuRasterizer(), tmp_path / "a", Progress(stop))
    resumed = agreed_features(*scene, second, CpuRasterizer(), tmp_path / "a", silent)
    at_once = agreed_features(*scene, whole, CpuRasterizer(), tmp_path / "b", silent)
    assert first.crops > 0
    assert first.crops + second.crops == whole.crops
    for one, other in zip(resumed, at_once, strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.vectors, other.vectors)
