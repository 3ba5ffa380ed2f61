"""`langsplat eval lerf-ovs`, `3d-ovs` and `scannet`: arguments, and one line for what is wrong with them."""

import json

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from tests.support.label_files import block, lerf_frame, mask_map, rectangle


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
