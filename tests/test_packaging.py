"""The wheel without extras; what a desktop is told of the viewer; `make gpu`, over a twin of gsplat."""

import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
from configparser import ConfigParser
from importlib.metadata import Distribution, distribution
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np
import pytest
from packaging.requirements import Requirement
from PIL import Image

from langsplat_core import load_scene
from langsplat_core.errors import EXTRAS
from langsplat_core.io.scenes import formats
from langsplat_core.raster.opengl.rasterizer import create_egl_context
from langsplat_viewer.state import TrainingForm
from langsplat_viewer.viewer import training_words

ROOT = Path(__file__).resolve().parents[1]
PACKAGING = ROOT / "packaging"
DESKTOP, GPU = PACKAGING / "desktop", PACKAGING / "gpu"
NAMESPACE = "{http://www.freedesktop.org/standards/shared-mime-info}"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """packaging/NAME.py as a module."""
    spec = importlib.util.spec_from_file_location(name, PACKAGING / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def desktop_entry() -> dict[str, str]:
    parser = ConfigParser(interpolation=None)
    parser.optionxform = str  # type: ignore[method-assign, assignment]
    parser.read(DESKTOP / "langsplat-viewer.desktop", encoding="utf-8")
    return dict(parser["Desktop Entry"])


def mime_globs() -> dict[str, list[str]]:
    made = subprocess.run([sys.executable, DESKTOP / "desktop_files.py"], capture_output=True, check=True)
    root = ElementTree.fromstring(made.stdout)
    globs = {k.attrib["type"]: k.findall(f"{NAMESPACE}glob") for k in root.findall(f"{NAMESPACE}mime-type")}
    return {kind: [glob.attrib["pattern"] for glob in its] for kind, its in globs.items()}


def test_desktop_entry_starts_the_viewer_with_a_file():
    entry = desktop_entry()
    assert entry["Type"] == "Application"
    assert entry["Exec"].split() == ["langsplat-viewer", "%f"]
    assert entry["TryExec"] == "langsplat-viewer"
    assert all(entry[key].endswith(";") for key in ("MimeType", "Categories", "Keywords"))


def test_desktop_entry_and_mime_types_cover_every_format():
    globs = mime_globs()
    assert set(desktop_entry()["MimeType"].strip(";").split(";")) == set(globs)
    patterns = {pattern for some in globs.values() for pattern in some}
    assert {f"*{row.suffix}" for row in formats()} <= patterns
    assert {row.mime for row in formats()} <= set(globs)


def test_frozen_viewer_trains_by_the_program_beside_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    request = TrainingForm(str(tmp_path / "photographs"), out=str(tmp_path / "scene.ply"))
    plain = training_words(request)
    monkeypatch.setattr("sys.frozen", True, raising=False)
    monkeypatch.setattr("sys.executable", str(tmp_path / "langsplat-viewer"))
    frozen = training_words(request)
    assert frozen == [str(tmp_path / "langsplat"), *plain[3:]]


def test_seeded_faults_stand_once_in_their_files(monkeypatch: pytest.MonkeyPatch) -> None:
    module = script("seeded_bugs", monkeypatch)
    faults = module.load_faults()
    assert len(faults) == 40
    assert [fault.name for fault in faults if fault.occurrences(module.ROOT) != 1] == []
    tests = {module.ROOT / "tests" / name for fault in faults for name in fault.tests.split()}
    assert [path for path in tests if not path.exists()] == []


# `make gpu`.


@pytest.fixture
def sections(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(GPU))
    return importlib.import_module("gpu_sections")


@pytest.fixture
def runner(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    return script("gpu/run", monkeypatch)


@pytest.mark.long
def test_gpu_sections_run_over_the_twin(sections: ModuleType, gsplat_twin: None, gl_session: object) -> None:
    for name, row in (("gradients", "| means_px |"), ("lifting", "| cuda |")):
        assert row in "\n".join(getattr(sections, f"measure_{name}")(sections.TINY))
    with create_egl_context() as context:
        assert "| splat | opengl single |" in "\n".join(sections.tables(sections.TINY, context))


@pytest.mark.long
@pytest.mark.skipif("__import__('torch').cuda.is_available()", reason="needs a machine without CUDA")
def test_gpu_run_without_a_gpu_writes_nothing(tmp_path, runner, monkeypatch, capsys):
    out = tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["run.py", "--only", "environment,gradients", "--out", str(out)])
    monkeypatch.setenv("PYTHONPATH", "")
    assert runner.main() == 2
    assert capsys.readouterr().err == "gpu: nothing could be run (no CUDA device); see docs/speed.md\n"
    assert not out.exists()


def test_container_has_what_the_makefile_installs_and_no_rights(monkeypatch):
    text = (PACKAGING / "Dockerfile").read_text()
    libraries = script("system_libraries", monkeypatch)
    wanted = {*libraries.NEEDED.values(), "libegl-mesa0", libraries.DRI_PACKAGE} - {"libusb-1.0-0"}
    assert set(re.findall(r" (lib\S+)", text.split("pip install")[0])) >= wanted  # libusb is open3d's alone
    assert "--constraint /source/packaging/constraints.txt /source" in text
    assert text.index("\nUSER viewer\n") < text.index('\nENTRYPOINT ["langsplat"]\n')


def test_workflow_and_devcontainer_name_what_there_is() -> None:
    text = (PACKAGING / "workflow.yml").read_text()
    assert pytest.importorskip("yaml").safe_load(text)["jobs"]["systems"]["steps"]
    command = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text())["onCreateCommand"]
    paths = [ROOT / name for name in re.findall(r"(?:packaging|tests)/[\w./]+", text + command)]
    assert len(paths) > 5
    assert [path for path in paths if not path.exists()] == []
    for target in re.findall(r"make (\w+)", command) or [""]:
        assert f"    make {target} " in (ROOT / "README.md").read_text()


def test_conda_recipe_asks_for_what_the_wheel_asks_for() -> None:
    recipe = pytest.importorskip("yaml").safe_load((PACKAGING / "conda" / "recipe.yaml").read_text())
    wheel = tomllib.loads((ROOT / "pyproject.toml").read_text())
    project, asked = wheel["project"], recipe["requirements"]
    there = [
        f"python{project['requires-python']}",
        *project["dependencies"],
        *wheel["build-system"]["requires"],
    ]
    wanted = sorted(re.sub("^glfw", "pyglfw", one) for one in there)
    assert sorted(one.replace(" ", "") for one in {*asked["run"], *asked["host"]} - {"pip"}) == wanted
    assert recipe["package"] == {"name": project["name"], "version": project["version"]}
    scripts = [f"{name} = {function}" for name, function in project["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == scripts


# The wheel without extras, in an environment that holds what it declares and nothing else: it opens, draws,
# searches and selects, and what needs an optional package ends with the line that installs it.

PARTS = ("pyproject.toml", "README.md", "LICENSE", "langsplat_core", "app", "assets", "packaging/wheel")
# Nothing but the environment's own packages.
CLEAN = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


def with_all_it_needs(first: Distribution) -> list[Distribution]:
    """Every distribution that `first` requires on this machine, directly or not, extras left out."""
    found: dict[str, Distribution] = {}
    waiting = [first]
    while waiting:
        for needed in map(Requirement, waiting.pop().requires or []):
            here = needed.marker is None or needed.marker.evaluate({"extra": ""})
            if here and needed.name.lower() not in found:
                found[needed.name.lower()] = distribution(needed.name)
                waiting.append(found[needed.name.lower()])
    return list(found.values())


@pytest.fixture(scope="module")
def light(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment with the wheel, and links to the packages it requires."""
    work = tmp_path_factory.mktemp("light")
    source = work / "source"
    left_out = shutil.ignore_patterns("__pycache__", "*.egg-info")
    for part in PARTS:
        (source / part).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / part).is_dir():
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


@pytest.mark.long
def test_plain_install_holds_no_optional_package(light: Path) -> None:
    look = "import importlib.util as i, sys; print(*[n for n in sys.argv[1:] if i.find_spec(n)])"
    found = run(light, "python", "-c", look, "numpy", "langsplat_assets", *EXTRAS)
    assert found.stdout.split() == ["numpy", "langsplat_assets"]
    (packages,) = light.parent.glob("lib/python*/site-packages")
    typed = sorted(path.parent.name for path in packages.glob("lang*/py.typed"))
    assert typed == ["langsplat_core", "langsplat_viewer"]


def test_types_are_found_from_outside_in_an_editable_install(tmp_path: Path) -> None:
    pytest.importorskip("mypy")
    script = "import langsplat_viewer\nfrom langsplat_core.query.engine import QueryEngine\n"
    (tmp_path / "script.py").write_text(script)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--follow-imports", "skip", "script.py"]
    done = subprocess.run(mypy, capture_output=True, text=True, check=False, cwd=tmp_path, env=CLEAN)
    assert "Success" in done.stdout, done.stdout


@pytest.mark.long
def test_plain_install_runs_the_demo_and_selects(light: Path, tmp_path: Path) -> None:
    done = run(light, "langsplat", "demo", "--no-open", "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "'blue gift': found" in done.stdout
    assert {path.name for path in tmp_path.iterdir()} == {"blue_gift.png", "room.html"}
    assert np.asarray(Image.open(tmp_path / "blue_gift.png")).std() > 10
    scene = next(light.parent.glob("lib/python*/site-packages/langsplat_assets/demo/scene.ply"))
    done = run(light, "langsplat", "select", scene, "keyboard", "--out", tmp_path / "keyboard.ply")
    assert done.returncode == 0, done.stderr
    assert 300 < len(load_scene(tmp_path / "keyboard.ply").gaussians.means) < 3000


@pytest.mark.long
def test_missing_package_ends_in_the_line_that_installs_it(light: Path, tmp_path: Path) -> None:
    for number in range(3):
        Image.new("RGB", (32, 24), (number, 0, 0)).save(tmp_path / f"{number}.png")
    done = run(light, "langsplat", "train", tmp_path, "--out", tmp_path / "scene.ply")
    assert done.returncode == 2
    said = r'langsplat: this needs (\w+): pip install "langsplat-viewer\[(\w+)\]"'
    found = re.fullmatch(said, done.stderr.strip())
    assert found is not None, done.stderr
    assert EXTRAS[found[1]] == found[2]
