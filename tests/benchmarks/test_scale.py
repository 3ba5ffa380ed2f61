"""The report on large sizes, made small. No figure is asserted."""

import json
import tempfile

import pytest

from langsplat_core.cli.run import main
from langsplat_core.io.scenes import save_scene
from tests.benchmarks.__main__ import PROGRAM, parse
from tests.benchmarks.scale import COARSE, PROPERTIES
from tests.support.fakes import blob_scene
from tests.support.file_samples import inria_names

pytestmark = pytest.mark.long

SMALL = """scale --rows 5001 --repeats 1 --lifted 400 2 --picture 64 48 --moving 0 --moving-size 160 100
--views 2 --count 3000 --size 40 30 --images 2 --phrases 9"""


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    """The whole report: its page, and its figures by their first field."""
    folder = tmp_path_factory.mktemp("scale")
    (folder / "temporary").mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tempfile, "tempdir", str(folder / "temporary"))
        assert main(PROGRAM, lambda: parse([*SMALL.split(), "--out", str(folder)])) == 0
    assert not list((folder / "temporary").iterdir())
    return (folder / "scale.md").read_text(), json.loads((folder / "scale.json").read_text())["rows"]


def test_both_readers_give_the_same_arrays(report):
    loadings = [row for row in report[1] if "reader" in row]
    assert [row["reader"] for row in loadings] == ["langsplat", "plyfile"]
    assert all(row["same"] and row["seconds"] > 0 for row in loadings)
    assert {row["kept_bytes"] for row in loadings} == {5001 * 59 * 4}
    assert loadings[0]["file_bytes"] > 5001 * 62 * 4
    assert list(PROPERTIES) == inria_names(3)


def test_lifting_is_measured_in_a_process_of_its_own(report):
    (cost,) = [row for row in report[1] if "relevancy_error" in row]
    assert (cost["gaussians"], cost["views"]) == (400, 2)
    assert cost["kept_bytes"] > 0


def test_coarser_images_are_farther_off(report):
    costs = [row for row in report[1] if "psnr" in row]
    assert tuple((cost["scale"], cost["merged"]) for cost in costs) == COARSE
    full, half, quarter, half_merged, quarter_merged = costs
    assert (full["psnr"], full["error"]) == (100, 0)
    assert 100 > half["psnr"] > quarter["psnr"] > 10
    assert half_merged["psnr"] > quarter_merged["psnr"] > 10
    assert full["gaussians"] == half["gaussians"] > 2 * half_merged["gaussians"]


def test_a_long_session_is_measured_part_by_part(report):
    rows = [row for row in report[1] if "what" in row]
    assert [row["times"] for row in rows if "phrase" in row["what"]] == [1, 2, 2, 2, 2]
    assert sum(row["times"] for row in rows if "image" in row["what"]) == 3
    assert report[0].count("\n## ") == 4


def test_a_scene_without_meaning_or_cameras_is_refused(tmp_path, capsys):
    for name, scene in (("plain", blob_scene(field=False)), ("bare", blob_scene(with_cameras=False))):
        save_scene(tmp_path / f"{name}.ply", scene)
        for part in ("moving", "endurance"):
            words = ["scale", str(tmp_path / f"{name}.ply"), "--only", part, "--out", str(tmp_path / "out")]
            assert main(PROGRAM, lambda words=words: parse(words)) == 2
    said = capsys.readouterr().err
    assert said.count("no language field") == said.count("no cameras") == 2
