"""Masked crops, what CLIP sees in them, and the store that lets a run continue."""

from collections.abc import Callable
from pathlib import Path
from threading import get_ident

import numpy as np
import pytest

from langsplat_core.arrays import unit
from langsplat_core.errors import InputError
from langsplat_core.progress import Progress, WorkCancelledError, silent
from langsplat_core.semantics.features import (
    FeatureStore,
    ImageFeatures,
    describe_capture,
    embed_regions,
    feature_key,
    fingerprint,
    masked_crop,
)
from langsplat_core.semantics.masks import LevelMasks, MaskSource
from tests.support.processes import stop_at


def test_a_square_region_of_the_right_size_is_copied_exactly() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mask = np.zeros((20, 30), bool)
    mask[4:12, 10:18] = True
    mask[6, 12] = False
    crop = masked_crop(image, mask, 8)
    want = image[4:12, 10:18].copy()
    want[2, 2] = 0  # black outside the mask, inside the box too
    np.testing.assert_array_equal(crop, want)


def test_a_wide_region_is_centred_between_black_bars() -> None:
    mask = np.zeros((20, 30), bool)
    mask[5:9, 2:14] = True  # 4 rows, 12 columns: 4 black rows above, 4 below
    crop = masked_crop(np.full((20, 30, 3), 200, np.uint8), mask, 12)
    assert (crop == np.repeat([0, 200, 0], 4)[:, None, None]).all()


def test_shrinking_averages_instead_of_picking_pixels() -> None:
    image = np.full((64, 64, 3), [[[255]], [[0]]] * 32, np.uint8)  # picking would give 0 or 255 everywhere
    crop = masked_crop(image, np.ones((64, 64), bool), 8)
    assert abs(crop[2:-2].astype(float) - 127.5).max() < 8


def test_an_empty_mask_is_refused() -> None:
    with pytest.raises(ValueError, match="empty"):
        masked_crop(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), bool), 8)


# Vectors of regions, and the store that lets a run continue.


class ColourEncoder:
    """Stands in for CLIP: the vector of a crop is its mean colour where it is not black."""

    id = "colours"
    image_size = 16
    calls = 0

    def encode_images(self, crops: np.ndarray) -> np.ndarray:
        self.calls += len(crops) > 1  # one picture alone asks which encoder this is
        seen = crops.reshape(len(crops), 16 * 16, 3).astype(np.float32)
        return unit(seen.max(axis=1) + 1e-3).astype(np.float32).reshape(len(crops), 3)


class Halves(MaskSource):
    """A mask source: left and right at subpart level, everything at whole level, no parts."""

    name = key = "halves"

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, image: np.ndarray, progress: Progress) -> LevelMasks:
        self.calls += 1
        progress("finding", 0.5)
        height, width = image.shape[:2]
        halves = np.zeros((2, height, width), bool)
        halves[0, :, : width // 2] = halves[1, :, width // 2 :] = True
        none, everything = np.zeros((0, height, width), bool), np.ones((1, height, width), bool)
        return halves, none, everything


def red_and_blue(height: int = 10, width: int = 20) -> np.ndarray:
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : width // 2, 0] = 200
    image[:, width // 2 :, 2] = 200
    return image


IMAGES = [np.roll(red_and_blue(), shift, axis=1) for shift in range(4)]
NAMES = ["a", "b", "c", "d"]


def assert_same(found: list[ImageFeatures], want: list[ImageFeatures]) -> None:
    for one, other in zip(found, want, strict=True):
        np.testing.assert_array_equal(one.labels, other.labels)
        np.testing.assert_array_equal(one.vectors, other.vectors)


def test_each_row_describes_its_own_region() -> None:
    labels = np.full((3, 10, 20), -1, np.int32)
    labels[0, :, :10], labels[0, :, 10:], labels[2, 2:8, 4:9] = 1, 0, 2  # not in order of position
    vectors = embed_regions(red_and_blue(), labels, ColourEncoder())
    np.testing.assert_allclose(vectors, [[0, 0, 1], [1, 0, 0], [1, 0, 0]], atol=1e-4)


def random_features() -> ImageFeatures:
    rng = np.random.default_rng(0)
    vectors = unit(rng.normal(size=(7, 512)).astype(np.float32))
    return ImageFeatures(rng.integers(-1, 7, (3, 9, 8)).astype(np.int32), vectors)


def test_a_store_returns_what_was_saved(tmp_path: Path) -> None:
    store, features = FeatureStore(tmp_path), random_features()
    assert not store.has("frame.001")
    store.save("frame.001", features, "a")
    assert [store.has("frame.001", *key) for key in ([], ["a"], ["another key"])] == [True, True, False]
    back = store.load("frame.001")
    np.testing.assert_array_equal(back.labels, features.labels)
    assert back.labels.dtype == np.int32
    assert (1 - (back.vectors * features.vectors).sum(axis=1)).max() < 1e-6  # half floats
    np.testing.assert_allclose(np.linalg.norm(back.vectors, axis=1), 1, atol=1e-6)


def test_more_regions_than_half_integers_hold(tmp_path: Path) -> None:
    labels = np.full((3, 200, 200), -1, np.int32)
    labels[0] = np.arange(40_000).reshape(200, 200)
    features = ImageFeatures(labels, np.full((40_000, 1), 1, np.float32))
    FeatureStore(tmp_path).save("many", features)
    np.testing.assert_array_equal(FeatureStore(tmp_path).load("many").labels, labels)


@pytest.mark.parametrize("name", ["left/001", "..", "ä b", "a.b.c"])
def test_a_store_keeps_any_name_in_its_folder(tmp_path: Path, name: str) -> None:
    store = FeatureStore(tmp_path / "store")
    store.save(name, random_features())
    assert store.has(name)
    assert [path.parent for path in tmp_path.rglob("*.npz")] == [tmp_path / "store"]


def test_the_key_changes_with_image_mask_source_and_encoder() -> None:
    image, others, thresholds = red_and_blue(), ColourEncoder(), Halves()
    others.id, thresholds.key = "others", "other thresholds"
    made_by = fingerprint(ColourEncoder())
    first = feature_key(image, None, Halves(), made_by)
    # Upside down this picture is the same one.
    assert feature_key(image[::-1], None, Halves(), made_by) == first
    keys = {
        first,
        feature_key(image, None, thresholds, made_by),
        feature_key(red_and_blue(20, 10), None, Halves(), made_by),
        feature_key(image, None, Halves(), fingerprint(others)),
        feature_key(image, image[..., 0] > 0, Halves(), made_by),
    }
    assert len(keys) == 5

    class Retrained(ColourEncoder):
        def encode_images(self, crops: np.ndarray) -> np.ndarray:
            return unit(super().encode_images(crops) * np.float32([1, 0.5, 0.2]))

    # Other weights under the same name.
    assert feature_key(image, None, Halves(), fingerprint(Retrained())) not in keys


def test_an_interrupted_run_continues_where_it_stopped(tmp_path: Path) -> None:
    source, encoder, store = Halves(), ColourEncoder(), FeatureStore(tmp_path)
    stop = stop_at(fraction=0.51, note="c")  # while its masks are being found
    with pytest.raises(WorkCancelledError):
        describe_capture(IMAGES, NAMES, source, encoder, store, stop)
    assert [store.has(name) for name in NAMES] == [True, True, False, False]
    assert len(list(tmp_path.iterdir())) == 2  # and nothing half written
    seen: list[float] = []
    progress = Progress(lambda at: seen.append(at.fraction))
    found = describe_capture(IMAGES, NAMES, source, encoder, store, progress)
    assert (source.calls, encoder.calls) == (3 + 2, 4)
    assert seen == sorted(seen)
    assert seen[-1] == 1.0
    assert_same(describe_capture(IMAGES, NAMES, Halves(), encoder, store, silent), found)
    assert encoder.calls == 4
    assert np.unique(found[0].labels).tolist() == [-1, 0, 1, 2]
    np.testing.assert_allclose(found[0].vectors[:2], [[1, 0, 0], [0, 0, 1]], atol=1e-4)


class InTwoParts(Halves):
    """A source whose filters run later, and fail for the photograph of that number."""

    def __init__(self, fails: int = -1) -> None:
        super().__init__()
        self.fails, self.log = fails, []

    def begin(self, image: np.ndarray, progress: Progress) -> Callable[[], LevelMasks]:
        number, found = self.calls, self(image, progress)
        self.log.append((number, "asked", get_ident()))

        def finish() -> LevelMasks:
            if number == self.fails:
                raise InputError("no room")
            self.log.append((number, "filtered", get_ident()))
            return found

        return finish


def test_filters_run_beside_the_model_of_the_next_photograph(tmp_path: Path) -> None:
    source, encoder = InTwoParts(), ColourEncoder()
    found = describe_capture(IMAGES, NAMES, source, encoder, FeatureStore(tmp_path / "two"))
    assert {thread for _, what, thread in source.log if what == "asked"} == {get_ident()}
    assert get_ident() not in {thread for _, what, thread in source.log if what == "filtered"}
    assert sorted(number for number, what, _ in source.log if what == "filtered") == [0, 1, 2, 3]
    assert_same(describe_capture(IMAGES, NAMES, Halves(), encoder, FeatureStore(tmp_path / "one")), found)


@pytest.mark.parametrize("fails", [1, 3])
def test_errors_of_filters_are_raised(fails: int, tmp_path: Path) -> None:
    store = FeatureStore(tmp_path)
    with pytest.raises(InputError, match="no room"):
        describe_capture(IMAGES, NAMES, InTwoParts(fails), ColourEncoder(), store)
    assert [store.has(name) for name in NAMES] == [n < fails for n in range(4)]
