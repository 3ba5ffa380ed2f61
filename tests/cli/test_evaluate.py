"""`langsplat eval lerf-ovs`, `3d-ovs` and `scannet`: arguments, and one line for what is wrong with them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.cli import evaluate
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.evaluation.report import PUBLISHED
from tests.support.label_files import block, lerf_frame, mask_map, rectangle
from tests.support.tiny_room import tiny_room, tiny_settings


@pytest.fixture
def data(tmp_path):
    lerf_frame(tmp_path / "data" / "label" / "a", "one", [("mug", rectangle(5, 5, 34, 24))])
    mask_map(tmp_path / "maps" / "one", "mug", block(5, 5, 34, 24))
    return tmp_path


def run(*words):
    return main("langsplat", lambda: parse(["eval", *map(str, words)]))


@pytest.mark.parametrize("protocol", ["langsplat-code", "langsplat-paper", "langsplat-v2"])
def test_maps_of_another_system(data, capsys, protocol):
    out = data / "out.json"
    words = ("lerf-ovs", data / "data", "--maps", data / "maps", "--protocol", protocol, "--json", out)
    assert run(*words) == 0
    (query,) = json.loads(out.read_text())["queries"]
    assert query["hit"]
    assert query["level"] == "subpart"
    assert query["grid"] == [40, 30]
    assert f"protocol {protocol}:" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("lerf-ovs", "data"), "give a scene and the benchmark's folder"),
        (("lerf-ovs", "scene.ply", "data", "--maps", "maps"), "alone with --maps"),
        (("lerf-ovs", "scene.ply", "data"), "no such scene"),
        (("lerf-ovs", "data", "--maps", "maps", "--paper-order"), "leave it out"),
        (("lerf-ovs", "absent", "--maps", "maps"), "no such folder"),
        (("lerf-ovs", "scene.ply", "data", "--train"), "give the benchmark's folder alone"),
        (("lerf-ovs", "data", "--train", "--clip.model", "demo", "--masks.source", "graph"), "a: "),
        (("3d-ovs", "data", "--maps", "maps"), "use `langsplat eval lerf-ovs`"),
        (("3d-ovs", "data", "--maps", "maps", "--protocol", "langsplat-code"), "invalid choice"),
        (("scannet", "data", "--maps", "maps"), "not in the layout of ScanNet"),
        (("lerf-ovs", "data", "--maps", "data"), "no folder is named after a labelled frame"),
    ],
)
def test_bad_arguments_are_one_line(data, monkeypatch, capsys, words, message):
    monkeypatch.chdir(data)
    assert run(*words) == 2
    error = capsys.readouterr().err.strip()
    assert message in error
    assert "\n" not in error
    assert not (data / "out.json").exists()


def test_scenes_are_trained_and_stand_beside_what_was_published(tmp_path, capsys, monkeypatch):
    """In LERF-OVS's layout; one scene cannot be trained, which is said after the table of the other."""
    monkeypatch.setattr(
        evaluate, "with_preset", lambda config, _: replace(tiny_settings(room), masks=config.masks)
    )
    room = tiny_room(tmp_path / "data" / "ramen")
    box = rectangle(0, 0, 63, 47)
    lerf_frame(tmp_path / "data" / "label" / "ramen", "photo_0", [("mug", box)], (64, 48))
    lerf_frame(tmp_path / "data" / "label" / "teatime", "photo_0", [("mug", box)], (64, 48))
    words = (
        "lerf-ovs",
        tmp_path / "data",
        "--train",
        "--out",
        tmp_path / "scenes",
        "--masks.source",
        "graph",
    )
    assert run(*words) == 2
    said = capsys.readouterr()
    assert "| this scene |" in said.out
    assert "| LangSplat | 51.2 / 73.2 | 51.2 / 73.2 |" in said.out
    assert "teatime" in said.err.strip().splitlines()[-1]
    made = (tmp_path / "scenes" / "ramen.ply").stat().st_mtime_ns
    assert run(*words, "--only", "ramen") == 0
    assert (tmp_path / "scenes" / "ramen.ply").stat().st_mtime_ns == made  # it is there already


def test_published_means_are_those_the_papers_state():
    """Of LangSplat on LERF-OVS 51.4 and 84.3, on 3D-OVS 93.4."""
    for name, scenes, mean in (("lerf-ovs", 4, (51.4, 84.3)), ("3d-ovs", 5, (93.4, None))):
        row = PUBLISHED[name]["LangSplat"]
        assert len(row) == scenes
        assert np.mean([iou for iou, _ in row.values()]) == pytest.approx(mean[0], abs=0.051)
        if mean[1] is not None:
            assert np.mean([place for _, place in row.values()]) == pytest.approx(mean[1], abs=0.051)
