"""The oracles: what a stage would have answered had it been perfect."""

from dataclasses import replace

import numpy as np

from assets.making.truth import Region, Truth
from assets.making.world import build_room
from langsplat_core.arrays import unit
from langsplat_core.lab.rooms.oracles import (
    moved_to_pictures,
    oracle_vectors,
    phrase_vectors,
    true_labels,
)
from langsplat_core.raster.cpu.rasterizer import CpuRasterizer
from langsplat_core.semantics.store import ImageFeatures
from tests.support.scenes import random_camera
from tests.support.two_blobs import two_blob_scene


class Speller:
    """A text encoder that gives every phrase its own axis and does not know cactuses."""

    def __init__(self) -> None:
        self.known: dict[str, int] = {}

    def encode_texts(self, texts):
        return np.stack(
            [np.eye(512, dtype=np.float32)[self.known.setdefault(t, len(self.known))] for t in texts]
        )

    def unknown_words(self, text):
        return tuple(word for word in text.split() if word == "cactus")

    def near_words(self, word):
        return ()


def test_perfect_embeddings_are_text_vectors_of_the_true_words():
    names = {0: "red mug", 1: "handle of the red mug", 2: "blue cactus", 3: ""}
    encoder = Speller()
    regions = {key: Region("whole", "", "", phrase=phrase) for key, phrase in names.items()}
    vectors = phrase_vectors(Truth(None, (), regions), encoder)
    assert set(vectors) == {0, 1}
    ids = np.full((3, 4, 5), 0)
    ids[1, :, :3], ids[1, :, 3:] = 1, 2
    ids[2, 0] = -1
    labels = np.full((3, 4, 5), -1, np.int32)
    labels[0], labels[1, :, :4], labels[1, :, 4:], labels[2] = 0, 1, 2, 3
    own = unit(np.random.default_rng(0).normal(size=(4, 512))).astype(np.float32)
    told = oracle_vectors(ImageFeatures(labels, own), ids, vectors)
    want = [encoder.encode_texts([text])[0] for text in ("red mug", "handle of the red mug")]
    np.testing.assert_array_equal(told.vectors, [want[0], want[1], own[2], want[0]])
    np.testing.assert_array_equal(told.labels, labels)


def test_text_vectors_are_moved_as_one():
    rng = np.random.default_rng(1)
    labels = np.zeros((3, 2, 2), np.int32)

    def described(mean):
        return ImageFeatures(labels, unit(rng.normal(size=(6, 8)) + mean).astype(np.float32))

    told, seen = [described(2.0), described(2.0)], [described(-2.0), described(-2.0)]
    moved = moved_to_pictures(told, seen)
    shift = np.mean([item.vectors for item in seen], (0, 1)) - np.mean(
        [item.vectors for item in told], (0, 1)
    )
    for got, text in zip(moved, told, strict=True):
        np.testing.assert_allclose(got.vectors, unit(text.vectors + shift), atol=1e-6)


def test_every_region_of_a_room_has_a_right_phrase():
    for label in build_room(5, "separate").labels:
        assert label.phrase in label.words or not label.phrase
        if label.thing:
            assert label.thing in label.phrase
            assert label.thing_colour in label.phrase


def test_a_gaussian_is_what_it_shows_most_of():
    scene, *_ = two_blob_scene()  # 60 Gaussians around x = -1, then 60 around x = 1, at z = 4
    camera = replace(random_camera(0, 64, 48, off_centre=False), world_to_camera=np.eye(4))
    alpha = CpuRasterizer().view(scene.gaussians, camera).splat(np.ones((120, 1), np.float32))[1]
    ids = np.full((3, 48, 64), -1)
    columns = np.arange(64)[None].repeat(48, 0)
    ids[2] = np.where(alpha > 0.02, np.where(columns < camera.cx, 7, 9), -1)
    got = true_labels(CpuRasterizer(), scene.gaussians, [(camera, ids)] * 2)
    assert (got[2][:60] == 7).all()
    assert (got[2][60:] == 9).all()
    assert (got[:2] == -1).all()
