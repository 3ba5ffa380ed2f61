"""`langsplat inspect` and `langsplat doctor`: what a scene holds, what this machine can do."""

import ctypes.util
import importlib.metadata
import json
import os
import platform
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path

import tyro
from rich.table import Table
from rich.text import Text

from langsplat_core import __version__
from langsplat_core.cli.console import OutputConsole
from langsplat_core.errors import BackendError, LangSplatError
from langsplat_core.extras import EXTRAS, remedy
from langsplat_core.formats import load_scene
from langsplat_core.formats.summary import NEEDLE, OPACITY_EDGES, SceneSummary, disk_bytes, summarise
from langsplat_core.query.engine import QueryEngine
from langsplat_core.semantics.encoder import OPEN_MODEL
from langsplat_core.semantics.encoders import load_text_encoder

OPTIONAL = ("torch", "transformers", "pycolmap", "open3d", "matplotlib", "gsplat")
LIBRARIES = {
    "EGL": "libegl1",
    "GL": "libgl1",
    "X11": "libx11-6",
    "usb-1.0": "libusb-1.0-0",
}  # Debian's packages


@dataclass(frozen=True)
class Inspect:
    """Print what a scene file holds, how healthy its rows are and where its bytes go."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    json: bool = False
    """Print JSON."""

    def run(self) -> None:
        scene = load_scene(self.scene)
        summary = summarise(scene)
        size = disk_bytes(self.scene)
        if self.json:
            said = {"scene": str(self.scene), "disk_bytes": size, "unread": scene.unread, **asdict(summary)}
            print(json.dumps(said, indent=1))
            return
        table = Table.grid(padding=(0, 2))
        for name, value in [("on disk", f"{size / 1e6:.2f} MB, companions included"), *_lines(summary)]:
            table.add_row(name, Text(value))
        if scene.language is not None:
            table.add_row("answers", Text(QueryEngine(scene).basis.long))
        for reason in scene.unread:
            table.add_row("not read", Text(reason))
        OutputConsole().print(table)


def _lines(a: SceneSummary) -> list[tuple[str, str]]:
    """Rows of the report: a name, and a value for people."""
    reasons = "".join(f"; {count} {reason}" for reason, count in a.invalid.items())
    low, high = (" ".join(f"{value:.3g}" for value in corner) for corner in a.bounds)
    median, most, largest = ("infinite" if ratio is None else f"{ratio:.3g}" for ratio in a.anisotropy)
    hidden, *shares = accumulate(a.opacity_shares)  # of the Gaussians below each edge
    below = [f"{_percent(s)} < {edge:g}" for s, edge in zip(shares, OPACITY_EDGES[2:-1], strict=False)]
    lines = [
        ("in memory", f"{a.memory_bytes / 1e6:.2f} MB"),
        ("Gaussians", f"{a.gaussians:,}"),
        ("invalid rows", f"{a.invalid_rows}{reasons}"),
        ("duplicates", f"{a.duplicates}"),
        ("bounds (1-99 %)", f"{low}  to  {high}"),
        ("opacity", ", ".join([f"{_percent(hidden)} never drawn", *below])),
        (
            "anisotropy",
            f"median {median}, 99 % {most}, largest {largest}; {a.needles} > {NEEDLE:g}",
        ),
        (
            "SH degree",
            f"{a.sh_degree}; energy by degree {' + '.join(f'{100 * e:.3g} %' for e in a.sh_energy)}",
        ),
        ("antialiased", "yes (Mip-Splatting)" if a.antialiased else "no"),
        ("scale", f"{a.metres_per_unit:g} m per unit" if a.metres_per_unit else "unknown: `langsplat scale`"),
        ("extra properties", ", ".join(a.extras) or "none"),
        ("cameras", f"{a.cameras}" if a.cameras else "none"),
    ]
    field = a.language
    if field is None:
        return [*lines, ("language field", "none")]
    observed = ", ".join(f"{name} {_percent(share)}" for name, share in field.observed.items())
    return [
        *lines,
        (
            "language field",
            f"codec {field.codec} of {field.size}; {field.bytes / 1e6:.2f} MB in memory",
        ),
        ("text encoder", f"{field.encoder}, {field.vector_dim} numbers"),
        ("phrasebook", f"{field.phrases} phrases"),
        ("observed", observed),
        ("things", "none" if field.things is None else f"{field.things}"),
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


@dataclass(frozen=True)
class Doctor:
    """Print what this machine has, for a report of trouble."""

    def run(self) -> None:
        print(f"langsplat        {__version__}")
        print(
            f"python           {platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"
        )
        for package in ("numpy", "numba", "moderngl", "imgui-bundle", *OPTIONAL):
            print(f"{package:<16} {_version(package)}")
        for library, package in LIBRARIES.items():
            found = ctypes.util.find_library(library)
            print(f"lib{library:<13} {found or f'missing: apt install {package}'}")
        print(f"DISPLAY          {os.environ.get('DISPLAY') or 'not set: use --headless'}")
        print(f"OpenGL           {_opengl()}")
        print(f"text encoder     {_encoder()}")


def _opengl() -> str:
    """What draws without a window, or why it cannot and what to do."""
    from langsplat_core.raster.opengl.context import create_egl_context

    try:
        context = create_egl_context()
    except BackendError as error:
        return str(error)
    try:
        about = context.info
        return f"{about['GL_VERSION']} on {about['GL_RENDERER']}"
    finally:
        context.release()


def _encoder() -> str:
    """Whether the bundled encoder works, and what real photographs want."""
    try:
        encoder = load_text_encoder("demo")
        encoder.encode_texts(["red mug"])
    except LangSplatError as error:
        return str(error)
    return f"demo: works; for real photographs `hf download {OPEN_MODEL}`, see docs/encoders.md"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return f"missing: {remedy(package)}" if package in EXTRAS else "missing"
