"""The query benchmark on a tiny scene. No test looks at a time."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.bench import QueryBenchConfig
from langsplat_core.bench.query import measure_queries, query_table, repeated, with_codec
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.errors import InputError
from langsplat_core.scene import CodebookCodec, LanguageField, Scene
from tests.support.fakes import DIM, PER_BLOB, FakeEncoder, axis, blob_scene
from tests.support.file_samples import random_codec

SMALL = QueryBenchConfig(size=(40, 30), phrases=2, together=3, repeats=1, codec_steps=40)


def codebook_scene() -> Scene:
    """The three blobs, each with a codeword of its own at all levels."""
    scene = blob_scene()
    codec = CodebookCodec(np.eye(3, DIM, dtype=np.float32), np.zeros((3, 3), np.float32))
    latents = np.tile(np.repeat(np.arange(3, dtype=np.uint16), PER_BLOB)[:, None], (3, 1, 1))
    confidence = np.ones((3, 3 * PER_BLOB), np.float32)
    confidence[0, :50] = 0
    return replace(
        scene, language=LanguageField(latents, confidence, codec, np.tile(axis(3), (4, 1)), "fake")
    )


@pytest.mark.long
def test_every_order_is_measured_against_what_it_should_find():
    report = measure_queries(codebook_scene(), FakeEncoder(), SMALL)
    paper, table, codebook = report.costs
    assert (report.gaussians, report.size, report.phrases) == (3 * PER_BLOB, (40, 30), 3)
    assert [cost.way for cost in report.costs] == ["paper's order", "table lookup", "codebook"]
    assert codebook.lookup.p99 < 1e-6
    assert codebook.codec == codebook.lookup  # its latents stand for the codewords themselves
    assert 0 < table.lookup.mean < table.codec.mean  # 40 steps fit nothing; the table shows what they did
    assert table.codec.mean == pytest.approx(paper.codec.mean, rel=0.1)
    for cost in report.costs:
        assert min(cost.answer, cost.camera, cost.frame) >= 0  # seconds: how many is not for a test to say
        assert cost.way in query_table(report)


def test_a_scene_without_a_codebook_is_refused():
    with pytest.raises(InputError, match="codebook"):
        measure_queries(blob_scene(), FakeEncoder(), SMALL)


def test_repeated_gaussians_lie_beside_their_own_with_their_meaning():
    scene = codebook_scene()
    larger = repeated(scene, 1000)
    assert len(larger.gaussians) == 1000
    assert larger.language is not None
    rows = np.arange(1000) % (3 * PER_BLOB)
    np.testing.assert_array_equal(larger.language.latents, scene.language.latents[:, rows])
    steps = (larger.gaussians.means - scene.gaussians.means[rows]) / np.exp(scene.gaussians.log_scales[rows])
    assert 0.9 < steps.std() < 1.1


def test_another_codec_encodes_the_codewords():
    field = codebook_scene().language
    wide = CodebookCodec(np.eye(3, 16, dtype=np.float32), np.zeros((3, 3), np.float32))
    field = replace(field, codec=wide, canonical=np.eye(16, dtype=np.float32)[[3] * 4])
    codec = random_codec("autoencoder")
    encoded = with_codec(field, codec)
    want = codec.encode(np.eye(3, 16, dtype=np.float32))[field.latents[2, :, 0]]
    np.testing.assert_array_equal(encoded.latents[2], want)
    assert (encoded.latents[0, :50] == 0).all()


@pytest.mark.long
def test_the_command_writes_what_it_measured(tmp_path, capsys):
    small = "--size 64 48 --phrases 2 --together 2 --repeats 1 --codec-steps 30"
    words = ["bench", "query", "assets/demo/scene.ply", *small.split(), "--out", str(tmp_path)]
    assert main("langsplat", lambda: parse(words)) == 0
    report = json.loads((tmp_path / "query.json").read_text())["report"]
    assert report["size"] == [64, 48]
    assert report["costs"][2]["lookup"]["p99"] < 1e-6
    assert (tmp_path / "query.md").read_text() in capsys.readouterr().out
    assert main("langsplat", lambda: parse([*words, "--repeats", "0"])) == 2
