"""`langsplat bench load`: that it measures what it says. No figure is asserted."""

import json
import tempfile

import pytest

from langsplat_core.cli.bench_load import BenchLoad
from langsplat_core.lab.speed.load import NAMES
from tests.support.file_samples import inria_names

pytestmark = pytest.mark.long


def test_both_readers_give_the_same_arrays_and_the_file_is_removed(tmp_path, monkeypatch, capsys):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    BenchLoad(count=5001, repeats=1, out=tmp_path / "out").run()
    loadings = json.loads((tmp_path / "out" / "load.json").read_text())
    assert [row["reader"] for row in loadings] == ["langsplat", "plyfile"]
    assert all(row["same"] for row in loadings)
    assert {row["kept_bytes"] for row in loadings} == {5001 * 59 * 4}
    assert loadings[0]["file_bytes"] > 5001 * 62 * 4
    assert all(row["seconds"] > 0 for row in loadings)
    assert (tmp_path / "out" / "load.md").read_text() in capsys.readouterr().out
    assert not list(temporary.iterdir())


def test_the_file_has_the_properties_of_the_inria_code():
    assert list(NAMES) == inria_names(3)
