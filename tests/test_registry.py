"""Extensions: a stranger's package adds a format and a command, a broken one costs a warning, and the program
works without any of the project's own."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from langsplat_core import registry
from langsplat_core.cli.app import command_names, parse
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene
from tests.support.scenes import random_gaussians

EXAMPLE = Path(__file__).parents[1] / "docs" / "examples" / "05_write_an_extension"
OWN = sorted(registry.extensions())


def langsplat(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run `langsplat` with the packages in the folder `site` beside those that are installed."""
    paths = os.pathsep.join([str(site), *sys.path])
    return subprocess.run(
        [sys.executable, "-m", "langsplat_core", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": paths},
    )


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the example is installed into, as a user would."""
    folder = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, folder / "source")
    install = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    target = ["--target", str(folder / "site"), str(folder / "source")]
    subprocess.run([sys.executable, "-m", "pip", *install, *target], check=True, capture_output=True)
    return folder / "site"


@pytest.mark.long
def test_installed_package_adds_a_format_and_a_command(example: Path, tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 255, (200, 6)).round(2)
    np.savetxt(tmp_path / "a.xyz", points)
    converted = langsplat(example, "convert", tmp_path / "a.xyz", tmp_path / "a.ply")
    assert (converted.returncode, converted.stderr) == (0, "")
    np.testing.assert_allclose(load_scene(tmp_path / "a.ply").gaussians.means, points[:, :3], rtol=1e-6)
    extent = langsplat(example, "extent", tmp_path / "a.ply")
    lengths = [float(word) for word in extent.stdout.split()[1:]]
    np.testing.assert_allclose(lengths, np.ptp(points[:, :3], axis=0), atol=1e-3)
    (tmp_path / "bad.xyz").write_text("one two three\n")
    refused = langsplat(example, "extent", tmp_path / "bad.xyz")
    assert refused.returncode == 2
    assert len(refused.stderr.splitlines()) == 1


def write_extension(site: Path, name: str, code: str) -> None:
    """Write a module with an entry point of the group, as an installed package has them."""
    (site / f"{name}.py").write_text(code)
    about = site / f"{name}-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{registry.GROUP}]\n{name} = {name}:EXTENSION\n")


@pytest.mark.long
@pytest.mark.parametrize(
    "code",
    [
        "raise RuntimeError('of\\nthe stranger')",
        "EXTENSION = 3",
        "from langsplat_core.registry import Extension\nEXTENSION = Extension(formats={'.x': 'none_such:F'})",
    ],
    ids=["raises", "is none", "names nothing"],
)
def test_broken_extension_costs_one_warning(code: str, tmp_path: Path) -> None:
    write_extension(tmp_path, "broken", code)
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(20)))
    done = langsplat(tmp_path, "convert", tmp_path / "a.ply", tmp_path / "b.splat")
    assert done.returncode == 0
    assert (tmp_path / "b.splat").exists()
    (warning,) = done.stderr.splitlines()
    assert "left out" in warning


def test_broken_part_is_refused_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = registry.Extension(exporters={"broken": "none_such:EXPORTER"})
    monkeypatch.setattr(registry, "extensions", lambda: {"a": broken})
    assert registry.parts("exporters") == {}
    with pytest.raises(registry.InputError, match="broken"):
        registry.part("exporters", "broken")


@pytest.mark.parametrize("hidden", OWN)
def test_help_shows_the_rest_with_an_extension_hidden(
    hidden: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    every = set(command_names())
    own = set(registry.extensions()[hidden].commands)
    monkeypatch.setenv(registry.HIDDEN, hidden)
    registry.extensions.cache_clear()
    try:
        assert set(command_names()) == every - own
        with pytest.raises(SystemExit):
            parse(["--help"])
        listed = capsys.readouterr().out
        for name in every:
            assert (f"• {name} " in listed) == (name not in own and " " not in name)
    finally:
        registry.extensions.cache_clear()
