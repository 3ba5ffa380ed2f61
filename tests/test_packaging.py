"""What a desktop is told of the viewer, and what the one-folder build is made of."""

import importlib.util
import subprocess
import sys
from configparser import ConfigParser
from pathlib import Path
from xml.etree import ElementTree

import pytest

from langsplat_core.io.scenes import FORMATS
from langsplat_viewer.viewer import TrainingRequest, command

PACKAGING = Path(__file__).resolve().parents[1] / "packaging"
DESKTOP = PACKAGING / "desktop"
NAMESPACE = "{http://www.freedesktop.org/standards/shared-mime-info}"


def desktop_entry() -> dict[str, str]:
    parser = ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[method-assign, assignment]
    parser.read(DESKTOP / "langsplat-viewer.desktop", encoding="utf-8")
    return dict(parser["Desktop Entry"])


def mime_globs() -> dict[str, list[str]]:
    made = subprocess.run([sys.executable, DESKTOP / "mime_types.py"], capture_output=True, check=True)
    root = ElementTree.fromstring(made.stdout)
    types = root.findall(f"{NAMESPACE}mime-type")
    return {
        kind.attrib["type"]: [g.attrib["pattern"] for g in kind.findall(f"{NAMESPACE}glob")] for kind in types
    }


def test_the_desktop_entry_starts_the_program_with_a_file():
    entry = desktop_entry()
    assert entry["Type"] == "Application"
    assert entry["Exec"].split() == ["langsplat-viewer", "%f"]
    assert entry["TryExec"] == "langsplat-viewer"
    assert all(
        entry["MimeType"].endswith(";") and entry[key].endswith(";") for key in ("Categories", "Keywords")
    )


def test_every_type_of_the_entry_is_described_and_every_kind_of_scene_has_one():
    globs = mime_globs()
    assert set(desktop_entry()["MimeType"].strip(";").split(";")) == set(globs)
    patterns = {pattern for some in globs.values() for pattern in some}
    assert {f"*{row.suffix}" for row in FORMATS} <= patterns
    assert {row.mime for row in FORMATS} == set(globs)


def test_a_one_folder_build_trains_by_the_program_beside_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    request = TrainingRequest(tmp_path / "photographs", tmp_path / "scene.ply")
    plain = command(request)
    monkeypatch.setattr("sys.frozen", True, raising=False)
    monkeypatch.setattr("sys.executable", str(tmp_path / "langsplat-viewer"))
    frozen = command(request)
    assert frozen[0] == str(tmp_path / "langsplat")
    assert frozen[1:] == plain[3:]


def test_a_row_of_another_machine_leaves_the_other_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    spec = importlib.util.spec_from_file_location("elsewhere", PACKAGING / "elsewhere.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "elsewhere", module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$*"\necho "$CODE failed, 2 passed, 3 skipped in 1s"\nexit $CODE\n')
    python.chmod(0o755)
    rows = [module.Row(f"row{n}", f"CODE={n}", folders="a b", python=str(python)) for n in range(3)]
    for name, value in {"ROOT": tmp_path, "OUT": tmp_path / "out", "TABLE": tmp_path / "table.md"}.items():
        monkeypatch.setattr(module, name, value)
    monkeypatch.setattr(module, "rows", lambda seed, newest: rows)
    for only, code in (("row1", 1), ("row0", 0), ("row2", 1)):
        monkeypatch.setattr("sys.argv", ["elsewhere.py", "--only", only])
        assert module.main() == code
    lines = [line.split(" | ")[:5] for line in (tmp_path / "table.md").read_text().splitlines()[-3:]]
    assert lines == [
        ["| row0", "`CODE=0`, `python`", "2", "0", "3"],
        ["| row1", "`CODE=1`, `python`", "2", "1", "3"],
        ["| row2", "`CODE=2`, `python`", "2", "ended with 2", "3"],
    ]
    assert "-n 2 --dist loadfile tests/a tests/b" in (tmp_path / "out" / "row1.txt").read_text()
