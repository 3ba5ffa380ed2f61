"""`langsplat inspect`, `doctor` and `demo`: what a scene holds, what this machine has, and a first look."""

import ctypes.util
import importlib.metadata
import logging
import os
import platform
import subprocess
import sys
import webbrowser
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

import tyro

from langsplat_core import __version__
from langsplat_core.cli.arguments import AnyScene, EncoderName, JsonOption, Needs, OutFolder
from langsplat_core.cli.run import print_json
from langsplat_core.errors import EXTRAS, BackendError, InputError, LangSplatError, printable_line, remedy
from langsplat_core.io.scenes import disk_bytes, load_scene, summarise
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.semantics import encoders

log = logging.getLogger("langsplat")
OPTIONAL = ("torch", "transformers", "pycolmap", "matplotlib", "gsplat", "open3d", "mcp", "av")
# Debian's packages
LIBRARIES = {"EGL": "libegl1", "GL": "libgl1", "X11": "libx11-6", "usb-1.0": "libusb-1.0-0"}


@dataclass(frozen=True)
class Inspect:
    """Print what a scene file holds, how healthy its rows are and where its bytes go."""

    scene: AnyScene
    json: JsonOption = False

    def run(self) -> None:
        scene = load_scene(self.scene)
        summary = summarise(scene)
        size = disk_bytes(self.scene)
        if self.json:
            print_json({"scene": str(self.scene), "disk_bytes": size, "unread": scene.unread, **summary})
            return
        lines = [("on disk", f"{size / 1e6:.2f} MB, companions included"), *_lines(summary)]
        if scene.language is not None:
            lines.append(("answers", QueryEngine(scene).basis.long))
        _print_rows([*lines, *(("not read", reason) for reason in scene.unread)])


def _lines(summary: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Rows of the report: a name, and a value for people."""
    reasons = "".join(f"; {count} {reason}" for reason, count in summary["invalid"].items())
    digits, metres = 10 if any(summary["origin"]) else 3, summary["metres_per_unit"]
    low, high = (" ".join(f"{value:.{digits}g}" for value in corner) for corner in summary["bounds"])
    lines = [
        ("in memory", f"{summary['memory_bytes'] / 1e6:.2f} MB"),
        ("Gaussians", f"{summary['gaussians']:,}"),
        ("invalid rows", f"{summary['invalid_rows']}{reasons}"),
        ("bounds (1-99 %)", f"{low}  to  {high}"),
        ("origin", " ".join(f"{value:.10g}" for value in summary["origin"])),
        ("SH degree", f"{summary['sh_degree']}"),
        ("antialiased", "yes (Mip-Splatting)" if summary["antialiased"] else "no"),
        ("scale", f"{metres:g} m per unit" if metres else "unknown: `langsplat scale`"),
        ("extra properties", ", ".join(summary["extras"]) or "none"),
        ("cameras", f"{summary['cameras']}" if summary["cameras"] else "none"),
    ]
    if (field := summary["language"]) is None:
        return [*lines, ("language field", "none")]
    observed = ", ".join(f"{name} {100 * share:.1f} %" for name, share in field["observed"].items())
    megabytes = field["bytes"] / 1e6
    nodes = "none" if field["nodes"] is None else f"{', '.join(map(str, field['nodes']))} nodes at the levels"
    return [
        *lines,
        ("language field", f"codec {field['codec']} of {field['size']}; {megabytes:.2f} MB in memory"),
        ("text encoder", f"{field['encoder']}, {field['vector_dim']} numbers"),
        ("phrasebook", f"{field['phrases']} phrases"),
        ("taught words", ", ".join(field["taught"]) or "none"),
        ("observed", observed),
        ("tree", nodes),
    ]


@dataclass(frozen=True)
class Doctor:
    """Print what this machine has, for a report of trouble, or with --encoder what an encoder is worth.

    The encoder is tried on the bundled room, in about a minute: its geometry beside real CLIP's, and how much
    of what is there is found. With --json this is what to send back about weights of your own.
    """

    encoder: EncoderName = ""
    """Try this encoder: demo, a hub id, a folder or a file of weights."""
    calibrate: Annotated[bool, Needs("encoder")] = False
    """Keep the calibration that the room gives, for all scenes of this encoder that have none."""
    json: JsonOption = False

    def run(self) -> None:
        if not self.encoder:
            machine = _machine()
            print_json(machine) if self.json else _print_rows(machine.items())
            return
        if self.calibrate and self.encoder == encoders.DEMO:
            raise InputError("--calibrate: the demo encoder has its own, and holds in drawn rooms alone")
        from langsplat_core.pipeline.encoder_check import check_encoder, report_lines

        with TerminalProgress() as progress:
            encoder = encoders.load_encoder(self.encoder, option="--encoder")
            report = check_encoder(encoder, progress)
        if self.json:
            print_json({"machine": _machine(), **asdict(report)})
        else:
            print(report_lines(report), end="")
        if self.calibrate:
            if report.calibration is None:
                raise InputError(f"--calibrate: nothing to keep; {report.reason}")
            kept = encoders.keep_calibration(encoder, report.calibration)
            log.info("kept in %s; without that file verdicts are by chance again", kept)


def _print_rows(rows: Iterable[tuple[str, str]]) -> None:
    for name, value in rows:
        print(f"{name:<16}  {printable_line(value)}")


def _machine() -> dict[str, str]:
    """Return the properties of this machine, by name."""
    about = f"{platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores"
    machine = {"langsplat": __version__, "python": about}
    machine |= {name: _version(name) for name in ("numpy", "numba", "moderngl", "imgui-bundle", *OPTIONAL)}
    if sys.platform == "linux":
        for library, package in LIBRARIES.items():
            found = ctypes.util.find_library(library)
            machine[f"lib{library}"] = found or f"missing: apt install {package}"
        machine["DISPLAY"] = os.environ.get("DISPLAY") or "not set: use --headless"
    return machine | {"OpenGL": _opengl(), "text encoder": _encoder()}


def _opengl() -> str:
    """Return the name of the offscreen OpenGL driver, or why there is none and the remedy."""
    from langsplat_core.raster.opengl.rasterizer import create_egl_context

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
    """Return the state of the bundled encoder, and the encoder that real photographs need."""
    try:
        encoder = encoders.load_text_encoder("demo")
        encoder.encode_texts(["red mug"])
    except LangSplatError as error:
        return str(error)
    return f"demo: works; for real photographs `hf download {encoders.OPEN_MODEL}`, see docs/encoders.md"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return f"missing: {remedy(package)}" if package in EXTRAS else "missing"


@dataclass(frozen=True)
class Demo:
    """Make a page and a picture of the bundled scene, answer a phrase, and open the page in a browser."""

    out: OutFolder = Path("demo_out")
    """Folder to write."""
    open: tyro.conf.FlagCreatePairsOff[bool] = True
    """Leave the page closed; else it opens in the browser, where there is one with a window."""

    def run(self) -> None:
        from langsplat_core.cli.export import Export

        page = self.out.resolve() / "room.html"
        Export(Path(str(files("langsplat_assets") / "demo" / "scene.ply")), page).run()
        # Not a browser of the terminal's; $BROWSER is one elsewhere, as remote editors and WSL have it.
        windows = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY", "BROWSER"} & {*os.environ}
        if not (self.open and windows and webbrowser.open(page.as_uri())):
            print(f"{page}: to be opened in a browser")
        viewer = [sys.executable, "-m", "langsplat_viewer"]
        if getattr(sys, "frozen", False):  # `make bundle`: the programs lie side by side
            viewer = [str(Path(sys.executable).with_stem("langsplat-viewer"))]
        picture = self.out / "blue_gift.png"
        command = [*viewer, "--headless", "--size", "960x720", "--query", "blue gift", "--out", str(picture)]
        if code := subprocess.run(command, check=False).returncode:
            raise LangSplatError(f"{picture}: not rendered; the viewer ended with code {code}")
        print(f"The picture is {picture}")
