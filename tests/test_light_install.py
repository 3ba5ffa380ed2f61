"""The wheel without extras, in an environment that holds what it declares and nothing else: it opens, draws,
searches and selects, and what needs an optional package ends with the line that installs it."""

import os
import re
import shutil
import subprocess
import sys
import venv
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core import load_scene
from langsplat_core.errors import EXTRAS

pytestmark = pytest.mark.long

ROOT = Path(__file__).resolve().parents[1]
PARTS = ("pyproject.toml", "README.md", "LICENSE", "langsplat_core", "app", "assets", "packaging/wheel")
NAME = re.compile(r"[\w.-]+")
# Nothing but the environment's own packages.
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def required(of: Distribution) -> set[str]:
    """Names of what a distribution requires on this machine, extras left out."""
    found = set()
    for line in of.requires or []:
        requirement, _, marker = line.partition(";")
        if "extra ==" not in marker and 'sys_platform == "win32"' not in marker:
            found.add(NAME.match(requirement.strip())[0])  # type: ignore[index]
    return found


def with_all_it_needs(first: Distribution) -> list[Distribution]:
    """Every distribution that `first` requires, directly or not, as it is installed here."""
    found: dict[str, Distribution] = {}
    waiting = list(required(first))
    while waiting:
        name = waiting.pop()
        if name.lower() in found:
            continue
        try:
            found[name.lower()] = distribution(name)
        except PackageNotFoundError:  # of another system, or another Python
            continue
        waiting += required(found[name.lower()])
    return list(found.values())


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment with the wheel, and links to the packages it requires."""
    work = tmp_path_factory.mktemp("light")
    source = work / "source"
    for part in PARTS:
        (source / part).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / part).is_dir():
            left_out = shutil.ignore_patterns("__pycache__", "*.egg-info")
            shutil.copytree(ROOT / part, source / part, symlinks=True, ignore=left_out)
        else:
            shutil.copy(ROOT / part, source / part)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    build = ["wheel", "--no-deps", "--no-index", "--no-build-isolation", "--wheel-dir", work, source]
    subprocess.run([*pip, *build], check=True, env=CLEAN)
    (wheel,) = work.glob("*.whl")
    venv.create(work / "env")
    programs = work / "env" / "bin"
    install = ["--python", programs / "python", "install", "--no-deps", "--no-index", "--no-compile", wheel]
    subprocess.run([*pip, *install], check=True, env=CLEAN)
    (packages,) = (work / "env").glob("lib/python*/site-packages")
    (ours,) = packages.glob("langsplat_viewer-*.dist-info")
    for package in with_all_it_needs(Distribution.at(ours)):
        for top in {Path(file).parts[0] for file in package.files or []} - {"..", "__pycache__"}:
            if not (packages / top).exists():
                (packages / top).symlink_to(package.locate_file(top))
    return programs


def run(light: Path, program: str, *options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [light / program, *options]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=light.parent, env=CLEAN)


def test_it_holds_none_of_the_optional_packages(light: Path) -> None:
    look = "import importlib.util as i, sys; print(*[n for n in sys.argv[1:] if i.find_spec(n)])"
    found = run(light, "python", "-c", look, "numpy", "langsplat_assets", *EXTRAS)
    assert found.stdout.split() == ["numpy", "langsplat_assets"]


def test_a_scene_is_drawn_and_searched(light: Path, tmp_path: Path) -> None:
    out = tmp_path / "heat.png"
    # OpenGL: the CPU's kernels would be compiled for this environment alone.
    asked = ("--query", "keyboard", "--backend", "opengl", "--size", "320x240")
    done = run(light, "langsplat-viewer", "--headless", "--out", out, *asked)
    assert (done.returncode, done.stderr) == (0, "")
    assert "'keyboard': found" in done.stdout
    assert np.asarray(Image.open(out)).std() > 10


def test_what_is_found_is_selected(light: Path, tmp_path: Path) -> None:
    scene = next(light.parent.glob("lib/python*/site-packages/langsplat_assets/demo/scene.ply"))
    done = run(light, "langsplat", "select", scene, "keyboard", "--out", tmp_path / "keyboard.ply")
    assert done.returncode == 0, done.stderr
    assert 300 < len(load_scene(tmp_path / "keyboard.ply").gaussians.means) < 3000


def test_a_missing_package_ends_in_the_line_that_installs_it(light: Path, tmp_path: Path) -> None:
    for number in range(3):
        Image.new("RGB", (32, 24), (number, 0, 0)).save(tmp_path / f"{number}.png")
    done = run(light, "langsplat", "train", tmp_path, "--out", tmp_path / "scene.ply")
    assert done.returncode == 2
    found = re.fullmatch(
        r'langsplat: this needs (\w+): pip install "langsplat-viewer\[(\w+)\]"', done.stderr.strip()
    )
    assert found is not None, done.stderr
    assert EXTRAS[found[1]] == found[2]
