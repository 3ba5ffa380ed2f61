"""The endurance benchmark on the bundled scene as it is. No figure is asserted."""

import json

import pytest

from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.io.scenes import save_scene
from langsplat_core.lab.speed.endurance import PARTS, parts
from langsplat_core.lab.speed.resident import peak_memory, resident_memory, restart_peak
from tests.support.fakes import blob_scene

pytestmark = pytest.mark.long


def test_the_command_writes_what_it_measured(tmp_path, capsys):
    words = ["bench", "endurance", "assets/demo/scene.ply", "--count", "3000", "--size", "40", "30"]
    words += ["--pictures", "2", "--phrases", "9", "--out", str(tmp_path)]
    assert main("langsplat", lambda: parse(words)) == 0
    rows = json.loads((tmp_path / "endurance.json").read_text())
    asked = [row["times"] for row in rows if "phrase" in row["what"]]
    assert asked == [1, 2, 2, 2, 2]
    assert sum(row["times"] for row in rows if "picture" in row["what"]) == 3
    assert all(row["seconds"] > 0 for row in rows)
    assert (tmp_path / "endurance.md").read_text() in capsys.readouterr().out


def test_a_scene_without_meaning_or_cameras_is_refused(tmp_path, capsys):
    for name, scene in (("plain", blob_scene(field=False)), ("bare", blob_scene(with_cameras=False))):
        save_scene(tmp_path / f"{name}.ply", scene)
        assert (
            main("langsplat", lambda n=name: parse(["bench", "endurance", str(tmp_path / f"{n}.ply")])) == 2
        )
    said = capsys.readouterr().err
    assert "no language field" in said
    assert "no cameras" in said


def test_parts_have_everything_once():
    done: list[int] = []
    for count in (1, 3, 4, 10):
        made = parts([lambda number=number: done.append(number) for number in range(count)])
        assert 0 < len(made) <= PARTS
        done.clear()
        for part in made:
            assert part
            for do in part:
                do()
        assert done == list(range(count))


def test_a_peak_begins_anew():
    if restart_peak() is None:
        pytest.skip("this system does not tell")
    block = bytearray(200_000_000)
    block[::4096] = b"x" * len(block[::4096])
    del block
    assert peak_memory() > resident_memory() + 100_000_000
    restart_peak()
    assert peak_memory() < resident_memory() + 100_000_000
