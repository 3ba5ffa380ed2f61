"""Viewers without a window."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from langsplat_viewer import options, program
from langsplat_viewer.actions import settings
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import FakeEncoder
from tests.support.windowless import ask, new_viewer, open_scene


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    """Nothing is open."""
    with new_viewer() as made:
        yield made


@pytest.fixture
def opened(viewer: Viewer) -> Viewer:
    """Shows the scene of three blobs."""
    open_scene(viewer, "blobs.ply")
    return viewer


@pytest.fixture
def asked(opened: Viewer) -> Viewer:
    """Answers "mug", in 120 x 90 pixels."""
    ask(opened, "mug")
    settings.resize(opened, 120, 90)
    return opened


@pytest.fixture(scope="module")
def display() -> Iterator[str]:
    """The name of a display: a virtual one of our own where Xvfb is installed, else the session's."""
    if shutil.which("Xvfb") is None:
        if not os.environ.get("DISPLAY"):
            pytest.skip("neither Xvfb nor a display")
        yield os.environ["DISPLAY"]
        return
    reading, writing = os.pipe()
    command = ["Xvfb", "-displayfd", str(writing), "-screen", "0", "1280x900x24", "-nolisten", "tcp"]
    server = subprocess.Popen(command, pass_fds=[writing], stderr=subprocess.DEVNULL)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        number = pipe.readline().strip()
    assert number, "Xvfb did not start"
    yield f":{number}"
    server.terminate()
    server.wait(10)


Run = Callable[..., tuple[int, list[str], list[str]]]


@pytest.fixture
def run_viewer(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Runs the console script's function; returns exit code, stdout lines, stderr lines."""
    monkeypatch.setattr(options, "load_text_encoder", lambda encoder_id: FakeEncoder())

    def run(*arguments: str) -> tuple[int, list[str], list[str]]:
        monkeypatch.setattr(sys, "argv", ["langsplat-viewer", *arguments])
        with pytest.raises(SystemExit) as stop:
            program.entry()
        captured = capsys.readouterr()
        return int(stop.value.code or 0), captured.out.splitlines(), captured.err.splitlines()

    return run
