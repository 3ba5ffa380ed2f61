"""What there is of this project outside: wheels of other systems, and programs that open its files.

    python packaging/outside.py wheels      # of every dependency, from pip's package index (`make wheels`)
    python packaging/outside.py programs    # which open what is written here, where installed (`make others`)

Prints a table in Markdown.
"""

import io
import json
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable, Mapping
from contextlib import redirect_stdout, suppress
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import numpy as np
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from scipy.spatial import cKDTree

from langsplat_core import load_scene
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# What pip calls a system -> what markers of dependencies ask of it.
SYSTEMS: Mapping[str, dict[str, str]] = {
    "win_amd64": {"sys_platform": "win32", "platform_system": "Windows", "platform_machine": "AMD64"},
    "macosx_14_0_arm64": {"sys_platform": "darwin", "platform_system": "Darwin", "platform_machine": "arm64"},
}


def declared(extra: str) -> list[Requirement]:
    """Return what pyproject.toml asks for, without extras or for one of them."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    own, extras = project["name"], project["optional-dependencies"]
    named = list(map(Requirement, extras[extra] if extra else project["dependencies"]))
    within = (declared(part) for one in named if one.name == own for part in sorted(one.extras))
    return [one for one in named if one.name != own] + [one for some in within for one in some]


def wheels(asked: Iterable[Requirement], system: str, python: str) -> dict[str, dict[str, object]]:
    """Return the metadata of the newest wheel of each, by name; nothing for one that has none."""
    asked = list(asked)
    pip = "-m pip install --quiet --dry-run --ignore-installed --no-deps --only-binary=:all: --report -"
    where = ["--platform", system, "--python-version", python, "--target", "unused"]
    words = [f"{one.name}{one.specifier}" for one in asked]
    done = subprocess.run([sys.executable, *pip.split(), *where, *words], capture_output=True, text=True)
    if done.returncode == 0:
        found = [one["metadata"] for one in json.loads(done.stdout)["install"]]
        return {canonicalize_name(one["name"]): one for one in found}
    if len(asked) > 1:
        return {name: made for one in asked for name, made in wheels([one], system, python).items()}
    if "No matching distribution" not in done.stderr:
        raise SystemExit(f"wheels: pip cannot be asked here: {done.stderr.strip().splitlines()[-1]}")
    return {}


def needed(first: list[Requirement], system: str, python: str) -> dict[str, str]:
    """Return the version of everything that `first` brings, by name; "" for what has no wheel."""
    found: dict[str, str] = {}
    while first:
        made = wheels(first, system, python)
        found |= {canonicalize_name(one.name): "" for one in first}
        found |= {name: str(one["version"]) for name, one in made.items()}
        marks = {
            **SYSTEMS[system],
            "python_version": python,
            "python_full_version": f"{python}.0",
            "extra": "",
        }
        deeper = {}
        for one in made.values():
            for below in map(Requirement, one.get("requires_dist", ())):  # type: ignore[call-overload]
                if below.marker is None or below.marker.evaluate(marks):
                    deeper[canonicalize_name(below.name)] = below
        first = [one for name, one in deeper.items() if name not in found]
    return found


def print_wheels() -> None:
    """Print, for each installation and system, what has no wheel for which versions of Python."""
    print(f"| Python {PYTHONS[0]} to {PYTHONS[-1]} | {' | '.join(f'`{system}`' for system in SYSTEMS)} |")
    print("|---|" + "---|" * len(SYSTEMS))
    for extra in ("", "train"):
        cells = []
        for system in SYSTEMS:
            asked = declared("") + (declared(extra) if extra else [])
            every = {python: needed(asked, system, python) for python in PYTHONS}
            lacks = {python: [name for name in found if not found[name]] for python, found in every.items()}
            said = [f"{python} not of {', '.join(names)}" for python, names in lacks.items() if names]
            cells.append("; ".join(said) or f"all of {max(map(len, every.values()))} packages")
        print(f"| {f'with `{extra}`' if extra else 'without extras'} | {' | '.join(cells)} |", flush=True)


# Which of the files that are written here each program opens.
PROGRAMS: Mapping[str, str] = {
    "plyfile": "scene.ply",
    "open3d": "scene.ply thing.glb",
    "trimesh": "thing.glb",
    "gsply": "scene.ply scene.spz rdf.spz",
    "gaussforge": "scene.ply scene.spz rdf.spz scene.sog scene.splat",
    "@playcanvas/splat-transform": "scene.ply scene.spz rdf.spz scene.sog scene.splat",
    "gltf-validator": "scene.glb thing.glb",
    "usd-core": "scene.usdc",
}
OURS = (".spz", ".sog", ".splat", ".glb", ".usdc")
NPM = ROOT / ".others" / "node_modules"
VALIDATE = """const { readFileSync } = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(readFileSync(process.argv[1]))).then(({ issues }) => {
  const errors = issues.messages.filter((one) => one.severity === 0);
  const unknown = errors.filter((one) => one.pointer.includes("KHR_gaussian_splatting:")).length;
  console.log(`${errors.length - unknown} errors, ${unknown} names unknown`); });"""


def node(*words: object) -> str:
    """Return what a program of npm prints."""
    command = [Path(sys.executable).with_name("node"), *map(str, words)]
    return subprocess.run(command, cwd=NPM, capture_output=True, text=True, check=True).stdout.strip()


def opened(program: str, path: Path) -> Any:  # noqa: PLR0911  a row of a table each
    """Return the (N, 3) positions that a program finds in a file, or what it says of it."""
    if program == "plyfile":
        vertex = import_module(program).PlyData.read(path)["vertex"]
        return np.stack([vertex[axis] for axis in "xyz"], 1)
    if program == "gsply":
        library = import_module(program)
        return (library.plyread if path.suffix == ".ply" else library.read_spz)(path).means
    if program == "gaussforge":
        read = import_module(program).GaussForge().read(path.read_bytes(), path.suffix[1:])
        return read.get("error") or np.frombuffer(read["data"]["positions"], np.float32).reshape(-1, 3)
    if program == "@playcanvas/splat-transform":
        node(NPM / program / "bin" / "cli.mjs", "-w", path, path.with_name("theirs.ply"))
        return load_scene(path.with_name("theirs.ply")).gaussians.means
    if program == "gltf-validator":
        return node("-e", VALIDATE, path)
    if program == "usd-core":
        stage = import_module("pxr.Usd").Stage.Open(str(path))
        (held,) = (prim for prim in stage.Traverse() if prim.HasAttribute("positions"))
        return str(held.GetTypeName())
    if path.suffix == ".ply":
        return np.asarray(import_module(program).io.read_point_cloud(str(path)).points)
    if program == "trimesh":
        surface = import_module(program).load(path, force="mesh")
        closed = surface.is_watertight
    else:
        surface = import_module(program).io.read_triangle_mesh(str(path)).merge_close_vertices(0)
        closed = surface.is_edge_manifold(allow_boundary_edges=False)
    return f"{'' if closed else 'not '}two triangles at every edge"


def version(program: str) -> str:
    """Return the version of what is installed, "" where nothing is."""
    if (said := NPM / program / "package.json").exists():
        return str(json.loads(said.read_text(encoding="utf-8"))["version"])
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(program)
    return ""


def print_programs() -> None:
    """Print for each program what it makes of files: how far positions lie from the scene's, at most."""
    scene = ROOT / "assets" / "demo" / "scene.ply"
    truth = cKDTree(load_scene(scene).gaussians.means)
    rows = ["| program | file: largest error of a position, units; or what it says |", "|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(scene, folder)
        for words in (
            *(["convert", scene, f"{folder}/scene{suffix}"] for suffix in OURS),
            ["convert", scene, f"{folder}/rdf.spz", "--axes", "rdf"],
            ["mesh", scene, f"{folder}/thing.glb", "--phrase", "teddy bear", "--watertight"],
        ):
            with redirect_stdout(io.StringIO()):
                main("outside", lambda words=words: parse([*map(str, words), "--quiet"]))
        for program, files in PROGRAMS.items():
            held, said = version(program), []
            for file in files.split() if held else ():
                try:
                    found = opened(program, Path(folder, file))
                except Exception as error:  # noqa: BLE001  whatever another program raises
                    found = f"fails ({type(error).__name__})"
                if not isinstance(found, str):
                    away = float(truth.query(found)[0].max()) if len(found) == truth.n else np.inf
                    found = "turned" if away > 0.05 else f"{away:.1e}" if away else "exact"
                said.append(f"{file}: {found}")
            rows.append(f"| {program.split('/')[-1]} {held} | {'; '.join(said) or 'not installed'} |")
    print(*rows, sep="\n")


if __name__ == "__main__":
    {"wheels": print_wheels, "programs": print_programs}[sys.argv[1]]()
