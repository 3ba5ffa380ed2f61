"""The report of a training: quality warnings, and a page that stands alone, where names stay text."""

import json
from collections.abc import Sequence
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array, ViewScore
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.workspace import Matches
from langsplat_core.pipeline.report import (
    APART,
    PAGE,
    REPORT,
    TrainReport,
    camera_groups,
    quality_warnings,
    read_report,
    stated_warnings,
    work_folder,
    write_reports,
)
from langsplat_core.scene import Scene, look_at
from tests.support.processes import open_browser
from tests.support.scenes import random_gaussians, ring

UP = np.array([0.0, 0.0, 1.0])


def score(psnr: float, covered: float = 0.9) -> ViewScore:
    return ViewScore("view", psnr, 0.8, covered)


def sizes(positions: Array) -> list[int]:
    return [len(group) for group in camera_groups(positions)]


def warnings_of(held_out=(), trained=(), **fields) -> tuple[str, ...]:
    """Warnings of a training on twelve views that share a thousand points, unless `fields` say otherwise."""
    points = fields.pop("points", np.random.default_rng(0).uniform(-0.3, 0.3, (1_000, 3)))
    colours = np.zeros(points.shape, np.uint8)
    made = replace(capture("abcdefghijkl"), points=points, colours=colours, **fields)
    return quality_warnings(made, range(len(made)), held_out, trained)


@pytest.mark.parametrize(
    ("found", "says"),
    [
        ({"held_out": [score(12.5), score(14.5)]}, "at 13.5 dB"),
        ({"held_out": [score(20, 0.3)]}, "only 30 %"),
        ({"trained": [score(21.0), score(22.5)]}, "at 21.8 dB, below 22"),
        ({"held_out": [score(22)], "trained": [score(30)]}, "8.0 dB worse"),
        ({"points": np.zeros((66, 3))}, "only 66 points"),
        ({"cameras": [look_at(np.array([0, -3, k / 99]), 0 * UP, UP, (64, 48)) for k in range(12)]}, "3.7 %"),
        ({"cameras": (*ring(7), *ring(5, centre=500.0))}, "2 groups far apart (7 and 5 photographs)"),
        ({"matches": Matches(tuple("abcdefg"), (9,) * 6 + (-1,), (), frozenset(range(4)))}, "2 of 6"),
    ],
)
def test_a_warning_is_one_sentence_with_a_remedy(found, says):
    assert warnings_of() == ()
    (warning,) = warnings_of(**found)
    assert says in warning
    assert "\n" not in warning
    assert "photograph" in warning.partition(":")[2]


@pytest.mark.parametrize("factor", [0.5, 0.9])
def test_cameras_are_grouped_across_wide_gaps_only(factor):
    line = np.zeros((20, 3))
    line[:, 0] = np.arange(20)
    line[10:, 0] += factor * APART - 1
    assert sizes(line) == [20]
    line[10:, 0] += APART
    assert sizes(line) == [10, 10]
    for positions in (np.zeros((0, 3)), np.zeros((1, 3)), np.ones((7, 3)), np.eye(3) * 1e9):
        assert sizes(positions) == [len(positions)]


def test_warnings_are_read_from_the_report_of_this_scene_alone(tmp_path: Path) -> None:
    scene = tmp_path / "s.ply"
    assert stated_warnings(scene, 3) == ()
    report = work_folder(scene) / REPORT
    report.parent.mkdir()
    report.write_text(json.dumps({"gaussians": 3, "warnings": ["dim: look\nagain", 4]}))
    assert stated_warnings(scene, 3) == ("dim: look again",)
    assert stated_warnings(scene, 4) == ()  # of another scene
    wrong = ("[]", "{", '{"gaussians": 3}', '{"gaussians": 3, "warnings": "all"}', "\udcff", "[" * 10_000)
    for text in wrong:
        report.write_bytes(text.encode("utf-8", "surrogateescape"))
        assert stated_warnings(scene, 3) == ()


# The page.

HOSTILE = "<script>alert(1)</script>\"'&\n"


class Read(HTMLParser):
    """Tags with their attributes, and the text between them."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def capture(names: Sequence[str], matches: Matches | None = None) -> Capture:
    cameras = [replace(camera, name=name) for name, camera in zip(names, ring(len(names)), strict=True)]
    images = tuple(np.full((48, 64, 3), 9 * k % 256, np.uint8) for k in range(len(names)))
    masks = (np.eye(48, 64, dtype=bool), *[None] * (len(names) - 1))
    none = np.zeros((0, 3))
    return Capture(tuple(cameras), images, none, none.astype(np.uint8), masks=masks, matches=matches)


def report(held_out: Sequence[str], **fields: object) -> TrainReport:
    scores = tuple(ViewScore(name, 21.4, 0.7123, 0.9) for name in held_out)
    stated = {
        "views": 6, "held_out": len(scores), "gaussians": 50, "psnr": 21.4 if scores else None,
        "masks": "graph", "encoder": HOSTILE, "mask_count": 7, "codec": "codebook", "codec_size": 8,
        "codec_cosine": 0.9,
        "relevancy_error": 0.01, "relevancy_error_p99": 0.02, "observed": 0.5, "warnings": (),
        "seconds": {"radiance": 3.0}, "dataset": f"/a/{HOSTILE.replace('/', '')}", "held_out_views": scores,
    }  # fmt: skip
    return TrainReport(**stated | fields)  # type: ignore[arg-type]


@pytest.mark.long
def test_page_shows_held_out_views_first_and_needs_no_other_file(tmp_path: Path) -> None:
    names = [f"{number}{HOSTILE}" for number in range(8)]
    matches = Matches(tuple(names), (900,) * 8, ((0, 1, 80), (1, 2, 20), (5, 6, 3)), frozenset(range(7)))
    made = report(names[2:4], warnings=("it is dim: add <light>",), psnr_small=22.7, held_out_rule="one in 4")
    others = [ViewScore(name, 30.0, 0.9, 0.9) for name in names if name not in names[2:4]]
    write_reports(tmp_path, made, capture(names, matches=matches), Scene(random_gaussians(50)), others)
    assert read_report(tmp_path) == made
    page = Read(tmp_path / PAGE)
    assert not {"link", "iframe", "light"} & {tag for tag, _ in page.tags}
    assert page.of("script") == [{}]  # the page's own
    sources = [image["src"] or "" for image in page.of("img")] + [i["href"] or "" for i in page.of("image")]
    assert len(page.of("img")) == 16
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    views = page.text.partition("what the scene shows there")[2]
    assert views.index("2<script>") < views.index("3<script>") < views.index("0<script>")
    assert views.count("held out") == 2
    for words in (
        "22.7 dB",
        "held out, one in 4",
        "it is dim: add <light>",
        "21.4 dB, SSIM 0.712",
        "7 of 8 photographs are located",
    ):
        assert words in page.text
    assert len(page.of("polygon")) == 8  # cameras from above
    with open_browser() as browser:
        tab = browser.new_context(offline=True, viewport={"width": 390, "height": 800}).new_page()
        asked: list[str] = []
        tab.on("request", lambda request: asked.append(request.url))
        tab.on("dialog", lambda dialog: asked.append(dialog.message))
        tab.goto((tmp_path / PAGE).as_uri())
        assert asked[0].startswith("file:")
        assert all(url.startswith("data:") for url in asked[1:])
        assert tab.evaluate("document.documentElement.scrollWidth") == 390
        tab.locator("input").first.fill("20")
        shown = "getComputedStyle(document.querySelector('.pair img + img')).clipPath"
        assert tab.evaluate(shown) == "inset(0px 0px 0px 20%)"
