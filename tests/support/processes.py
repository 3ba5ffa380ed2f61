"""The program `langsplat` in this process and in children; what stops programs; windows and browsers.

python -m tests.support.processes FOLDER    runs `langsplat convert` for every FOLDER/NAME.pth
"""

import base64
import ctypes
import errno
import gc
import importlib
import json
import os
import pkgutil
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rich.console  # noqa: F401  before anything is taken away: it would draw as on Windows

from langsplat_core.arrays import Array
from langsplat_core.cli.app import parse
from langsplat_core.cli.export import Convert
from langsplat_core.cli.run import main
from langsplat_core.io import apart
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_core.scene import Camera

PR_CAPBSET_DROP, CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH = 24, 1, 2  # linux/prctl.h, linux/capability.h


def bound_by_permissions() -> Callable[[], None] | None:
    """`preexec_fn` for `subprocess`, by which an administrator gives up rights to pass over permissions."""
    if os.geteuid() != 0:
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def give_up() -> None:
        for right in (CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH):
            if prctl(PR_CAPBSET_DROP, right, 0, 0, 0) != 0:
                raise OSError(ctypes.get_errno(), "cannot give up a right")

    return give_up


def python(*words: object, bound: bool = False, **where: Any) -> subprocess.CompletedProcess[str]:
    """Run Python; bound: by permissions, whoever runs it. where: folder, environment, time limit."""
    command, before = [sys.executable, *map(str, words)], bound_by_permissions() if bound else None
    return subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=before, **where)


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """What runs in a process of its own runs in this one, where what is patched is so for it too."""
    monkeypatch.setattr(apart, "run", lambda function, *given, progress, **_: function(*given, progress))


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """Any file of this process ends at `size` bytes, in the middle of what is written, as on a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))  # its signal is ignored by Python
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def stop_at(stage: str = "", fraction: float = 0.0, note: str = "") -> Progress:
    """Progress that cancels the work where a stage, named by how it begins, has come so far; at a note."""

    def show(at: Report) -> None:
        if at.stage.startswith(stage) and at.fraction >= fraction and note in at.note:
            raise WorkCancelledError

    return Progress(show)


@contextmanager
def small_disk(folder: Path, size: int) -> Iterator[Path]:
    """A file system in memory of so many bytes, see `resize`; skips where one may not be mounted."""
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting a file system needs root")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True, capture_output=True)


def in_a_fork(work: Callable[[], object]) -> int:
    """The exit code of `work` in a fork of this process; negative: the signal that killed it."""
    if (child := os.fork()) == 0:
        code = 1
        try:
            code = int(work() or 0)
        except BaseException:  # noqa: BLE001  as at the end of any program
            sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        finally:
            sys.stderr.flush()
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def resize(disk: Path, size: int) -> None:
    """Make a `small_disk` larger."""
    subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True, capture_output=True)


# Programs of this tree, played on a virtual display in a process of their own.

ROOT = Path(__file__).parents[2]


def surroundings(display: str) -> dict[str, str]:
    """The environment of a program on `display`."""
    inherited = {key: value for key, value in os.environ.items() if key != "WAYLAND_DISPLAY"}
    return inherited | {"DISPLAY": display, "PYTHONPATH": os.pathsep.join((str(ROOT), str(ROOT / "app")))}


def play(display: str, arguments: list[str], folder: Path, timeout: float, **environment: str) -> str:
    """Return what Python says with `arguments`, in `folder`, within `timeout` seconds; it has to end well."""
    done = python(*arguments, env=surroundings(display) | environment, cwd=folder, timeout=timeout)
    assert done.returncode == 0, (done.stdout + done.stderr)[-4000:]
    return done.stdout


class Cast:
    """A process that imports a module that calls `serve` once, and plays it in forks of itself."""

    def __init__(self, module: str, display: str) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", module],
            env=surroundings(display),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def play(self, arguments: list[str], folder: Path, timeout: int) -> str:
        """As the function of this name."""
        self._process.stdin.write(json.dumps([arguments, str(folder), timeout]) + "\n")
        self._process.stdin.flush()
        code, said = json.loads(self._process.stdout.readline())
        assert code == 0, said[-4000:]
        return said

    def close(self) -> None:
        self._process.communicate()


def serve(play_one: Callable[[list[str]], None]) -> None:
    """Play what `Cast` asks for, one after another, each in a process that ends as any other does."""
    for line in sys.stdin:
        arguments, folder, timeout = json.loads(line)
        said = Path(folder) / "said.txt"
        if (child := os.fork()) == 0:
            signal.alarm(timeout)
            os.chdir(folder)
            with said.open("wb") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            return play_one(arguments)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        print(json.dumps([code, said.read_text()]), flush=True)
        said.unlink()


# Pages in a real browser: Debian's Chromium, without a screen, a graphics card or a network.

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync"
)
IMAGE = """async ([camera, display, phrase]) => {
  const bytes = await (await langsplat).image(camera, display, phrase);
  let letters = "";
  for (let i = 0; i < bytes.length; i += 8192) letters += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(letters);
}"""


class Tab:
    """A page that is open, with all that it asked for and said."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.requests: list[str] = []
        self.faults: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))

    def open(self, path: Path) -> None:
        """Open a file and wait until its scene is there."""
        self.page.goto(path.as_uri())
        self.page.evaluate("langsplat.then(() => 0)")

    def run(self, script: str, argument: Any = None) -> Any:
        """Return what a function in JavaScript returns."""
        return self.page.evaluate(script, argument)

    def ask(self, phrase: str, level: str = "auto", whole: bool = True) -> dict[str, Any]:
        """The page's answer to a phrase, asked whole or as typed, and the number of its members."""
        found: dict[str, Any] = self.run(
            """async ([phrase, level, whole]) => {
              const { page: { language }, ask } = await langsplat;
              const answer = whole ? language.drawn(language.ask(phrase, level)) : ask(phrase, level);
              const { values, members } = answer;
              const sum = (numbers) => numbers.reduce((a, b) => a + b, 0);
              return { ...answer, ...answer.verdict, verdict: answer.verdict.outcome,
                       by_chance: answer.verdict.byChance, regionFits: null,
                       even: null, values: null, rows: null, smooth: null, members: sum(members),
                       mean: sum(values) / values.length };
            }""",
            [phrase, level, whole],
        )
        return found

    def image(self, camera: Camera, origin: Array, display: str = "rgb", phrase: str = "") -> Array:
        """Return (H, W, 3) uint8 of a camera, which stands `origin` (3,) away from where the page has it."""
        pose = {"rotation": camera.rotation.ravel().tolist(), "position": (camera.position - origin).tolist()}
        inner = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        letters = self.run(IMAGE, [pose | inner, display, phrase])
        image = np.frombuffer(base64.b64decode(letters), np.uint8)
        return image.reshape(camera.height, camera.width, 4)[::-1, :, :3]


@contextmanager
def open_browser() -> Iterator[Any]:
    """A browser; the test is skipped where there is none."""
    found = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if found is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    driver = pytest.importorskip("playwright.sync_api", reason="no playwright here: pip install playwright")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS.split())
        yield browser
        browser.close()


@contextmanager
def open_tab(browser: Any, path: Path, before: str = "", **settings: Any) -> Iterator[Tab]:
    """A file open in a profile of its own, after a script; settings: of playwright's `new_context`."""
    context = browser.new_context(offline=True, **{"viewport": {"width": 480, "height": 360}} | settings)
    try:
        context.add_init_script(before)
        tab = Tab(context.new_page())
        tab.open(path)
        yield tab
    finally:
        context.close()


# The program `langsplat`.


def run(*words: object) -> int:
    """The exit code of `langsplat` with these words."""
    return main("langsplat", lambda: parse([str(word) for word in words]))


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line with which `langsplat` refuses these words; nothing is printed beside it."""
    capsys.readouterr()
    assert run(*words) == 2
    said = capsys.readouterr()
    assert said.out == ""
    (line,) = (line for line in said.err.splitlines() if line.startswith("langsplat"))
    return line


# A command once for each of many files, each in a child of one process that has all imports behind it: what
# crashes is told from what refuses, and starting torch is paid for once.

ROOM, SECONDS = 3 << 30, 20  # bytes of address space beyond the parent's, seconds of the processor


@dataclass(frozen=True)
class Ended:
    """End of a child."""

    code: int  # negative: the number of the signal that killed it
    said: str  # on the standard error
    wrote: bool  # anything beside its log


def convert_each(folder: Path) -> dict[str, Ended]:
    """`langsplat convert` of every checkpoint in `folder`, by name."""
    command = [sys.executable, "-m", __name__, str(folder)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return {name: Ended(*how) for name, how in json.loads(done.stdout).items()}


def _child(path: Path) -> tuple[int, str, bool]:
    folder = path.with_suffix("")
    folder.mkdir()
    log = path.with_suffix(".log")

    def convert() -> int:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(os.open(log, os.O_CREAT | os.O_WRONLY), 2)
        held = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (held + ROOM,) * 2)
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS,) * 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        return main("langsplat", lambda: Convert(path, (folder / "out.ply",)))

    return in_a_fork(convert), log.read_text(), any(folder.iterdir())


def _all(folder: Path) -> None:
    import torch  # noqa: F401  once for all children

    import langsplat_core.extensions.checkpoints.importing  # noqa: F401

    gc.freeze()  # or every child copies what its first collection touches
    print(json.dumps({path.stem: _child(path) for path in sorted(folder.glob("*.pth"))}))


# The law of a full disk, for any function that writes: exit code 2, one line, and what was there stays.


Write = Callable[[Path], object]  # gets a folder of its own
Captured = pytest.CaptureFixture[str]


@dataclass
class _Command:
    """A command that writes."""

    write: Write
    folder: Path

    def run(self) -> None:
        self.write(self.folder)


def contents(folder: Path) -> dict[str, bytes]:
    """Return what lies in a folder, file by file."""
    found = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in found}


def check_full_disk(write: Write, tmp_path: Path, capsys: Captured, earlier: bytes | None) -> None:
    """Cut off every file at its beginning, its middle and its last byte; `earlier`: what was there before."""
    folder = tmp_path / "out"
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    before = {} if earlier is None else dict.fromkeys(whole, earlier)
    sizes = {len(content) for content in whole.values()}
    for size in sorted({0, *(length // 2 for length in sizes), *(length - 1 for length in sizes)}):
        shutil.rmtree(folder, ignore_errors=True)
        for path in whole:
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
        for path, content in before.items():
            (folder / path).write_bytes(content)
        with files_of_at_most(size):
            code = main("langsplat", lambda: _Command(write, folder))
        (line,) = capsys.readouterr().err.splitlines()
        assert code == 2
        assert "File too large" in line
        assert any(Path(path).name in line for path in whole), line
        after = contents(folder)
        assert before.keys() <= after.keys() < whole.keys() | before.keys() | {"nothing else"}
        for path, content in after.items():
            assert content == before.get(path) or len(content) == len(whole[path])


STEPS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.chmod", "os.chown", "os.truncate"}


def killed_everywhere(work: Callable[[], int | None], folder: Path) -> Iterator[int]:
    """Do `work` in forks of this process, each killed at another of its steps in `folder`.

    Steps open, make, rename or remove a file. Yields exit codes, the last of a fork that ended otherwise.
    """

    def killed(left: Iterator[int]) -> int | None:
        def watch(event: str, given: tuple[object, ...]) -> None:
            if event in STEPS and str(given[0]).startswith(str(folder)) and next(left, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)

        signal.alarm(60)  # of threads a fork has none, and may wait for one
        sys.addaudithook(watch)
        return work()

    for last in range(500):
        yield (code := in_a_fork(partial(killed, iter(range(last)))))
        if code != -signal.SIGKILL:
            return


# Windows, as far as it can be had here.

LACKING = "chown fork geteuid getuid killpg link mkfifo posix_fallocate sched_getaffinity symlink uname"
NO_NAME = re.compile(r"""(?i)[<>:"|?*\\]|[. ]$|^(con|prn|aux|nul|com\d|lpt\d)(\.|$)""")


def files_in_use() -> set[str]:
    """The files that this process has open, or mapped into its memory."""
    maps = Path("/proc/self/maps").read_text(encoding="utf-8").splitlines()
    opened = (os.path.realpath(f"/proc/self/fd/{number}") for number in os.listdir("/proc/self/fd"))
    return {line.split(maxsplit=5)[5] for line in maps if "/" in line} | set(opened)


def as_on_windows() -> None:
    """Take away, for the rest of this process, what Windows lacks: replacing open files, and some names."""
    sys.modules.update(dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios")))  # type: ignore[arg-type]
    for name in LACKING.split():
        delattr(os, name)
    shutil._use_fd_functions = False  # type: ignore[attr-defined]  # noqa: SLF001  by opening folders
    asking = threading.local()

    def refuse(event: str, given: tuple[Any, ...]) -> None:
        if event not in STEPS or not isinstance(given[0], str | os.PathLike) or hasattr(asking, "on"):
            return
        asking.on = True  # what follows opens files too
        ends = [os.path.realpath(end) for end in given[: 1 + (event == "os.rename")]]
        in_use = event in ("os.rename", "os.remove") and files_in_use() & set(ends)
        del asking.on
        writes = event in ("os.rename", "os.mkdir") or (event == "open" and given[2] & os.O_CREAT)
        if in_use or (writes and NO_NAME.search(os.path.basename(ends[-1]))):
            raise PermissionError(errno.EACCES, "in use, or no name on Windows", ends[-1])
        if ends[0].startswith(("/proc/", "/dev/shm/")):
            raise FileNotFoundError(errno.ENOENT, "no such place on Windows", ends[0])

    sys.addaudithook(refuse)


def use_on_windows(folder: Path) -> None:
    """Import every module of the program, then open, ask and save the bundled scene."""
    importlib.import_module("torch")  # which would look for libraries of this system
    as_on_windows()
    for package in map(importlib.import_module, ("langsplat_core", "langsplat_viewer")):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    sys.platform = "win32"
    scene, saved, duck = ROOT / "assets" / "demo" / "scene.ply", folder / "s.ply", "duck: \u0160 \u2192"
    assert run("doctor") == 0
    for suffix in 2 * (".ply", ".sog"):
        assert run("convert", scene, folder / f"s{suffix}") == 0
    assert run("convert", scene, folder / "aux.ply") == 2
    of_another_program = saved.with_suffix(".langsplat.safetensors").open("rb")
    threading.Timer(0.5, of_another_program.close).start()
    assert run("teach", saved, "--at", "412,230", "--name", duck) == 0
    assert run("scale", saved, "--metres-per-unit", "2") == 0
    assert run("query", saved, duck, "blue gift") == 0
    assert run("select", scene, "blue gift", "--out", folder / "gift.ply") == 0
    assert run("export", folder / "gift.ply", folder / "gift.html") == 0


if __name__ == "__main__":
    use_on_windows(Path(sys.argv[2])) if "--as-on-windows" in sys.argv else _all(Path(sys.argv[1]))
