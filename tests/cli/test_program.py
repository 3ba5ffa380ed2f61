"""The command line as a whole: commands, options, those that do not exist; each ends in a line."""

import contextlib
import dataclasses
import io
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
import webbrowser
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tyro.extras import get_parser

from langsplat_core import __version__
from langsplat_core.cli.app import command_names, entry, load_command, parse
from langsplat_core.cli.run import ROLES, main
from langsplat_core.cli.scenes import Doctor
from langsplat_core.config import check_settings, range_of
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene, save_scene, writable_suffixes
from langsplat_core.pipeline import encoder_check
from langsplat_viewer.program import ViewerCommand
from langsplat_viewer.program import entry as viewer_entry
from langsplat_viewer.program import parse as viewer_parse
from tests.support.fakes import numeric_settings
from tests.support.processes import refusal, run
from tests.support.scenes import DEMO
from tests.support.tiny_models import tiny_clip

EVERY = {"viewer": ViewerCommand} | {name: load_command(name) for name in command_names()}


def parsed_as(name, words):
    return viewer_parse(words) if name == "viewer" else parse([*name.split(), *words])


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_option_is_described(name, capsys):
    """By phrases that need no other's, roles in place of types, and defaults that are some."""
    actions = get_parser(EVERY[name], registry=ROLES)._actions  # noqa: SLF001  there is no public list
    assert len(actions) > len(dataclasses.fields(EVERY[name])) // 2
    said = {one.dest: (one.help or "").partition("(default")[0].replace("(required)", "") for one in actions}
    assert [option for option, text in said.items() if len(text.strip()) < 3 or "\n" in text] == []
    fragment = r"(of|times|at|asked) |.* (of|behind) that *$|.*between two of them|.*the following"
    assert [text for text in said.values() if re.match(fragment, text)] == []
    with pytest.raises(SystemExit):
        parsed_as(name, ["--help"])
    empty = r"\(default: (?:None|True|False|'')?\)|\{None|\bSTR\b|\bPATH\b(?!\.)|can be overridden"
    printed = " ".join(capsys.readouterr().out.split())
    assert re.findall(empty, printed) == []
    assert name not in ("convert", "select") or {*writable_suffixes()} <= {*re.findall(r"\.[a-z]+", printed)}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["qurey", "a.ply"], "no command 'qurey'; did you mean 'query'?"),
        (["xyz"], "no command 'xyz'; there are train, query"),
        (["convert", "a.ply", "--out"], "--out: names nothing"),
        (["-v", "doctor", "-q"], "--quiet and --verbose: one says less"),
        (["--tyro-print-completion", "ksh"], "--tyro-print-completion ksh: there is bash, zsh"),
    ],
)
def test_unknown_commands_and_shells_are_named(words, said):
    with pytest.raises(InputError) as error:
        parse(words)
    assert str(error.value).startswith(said)


def test_empty_names_are_refused(capsys):
    """As of a shell's variables that are not set: `Path` takes them for "."."""
    for line in ("inspect ", "train  -o a", "select a.ply x -o ", "export a.ply ", "query a.ply x --work "):
        assert "an empty name; is a variable" in refusal(capsys, *line.split(" "))


@pytest.mark.parametrize(("program", "begin"), [("langsplat", entry), ("langsplat-viewer", viewer_entry)])
@pytest.mark.parametrize("words", [[], ["train"]])
def test_version_is_printed(program, begin, words, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [program, *words, "--version"])
    with pytest.raises(SystemExit) as stop:
        begin()
    assert not stop.value.code
    assert capsys.readouterr().out == f"{program} {__version__}\n"


def test_home_is_meant_where_no_shell_says_so(tmp_path, monkeypatch):
    """As after "=", in quotes, and in a file of settings; a name that only begins with ~ is a name."""
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "a.toml").write_text('work = "~/w"\n')
    train = parse(["train", "~/photos", "--out=~/a.ply", f"--config={tmp_path / 'a.toml'}"])
    assert (*train.dataset, train.out) == (tmp_path / "photos", tmp_path / "a.ply")
    assert train.work == tmp_path / "w"
    assert viewer_parse(["~old.ply"]).scene == Path("~old.ply")


@pytest.mark.parametrize(("flag", "level"), [("-q", "ERROR"), ("--verbose", "DEBUG")])
def test_verbosity_may_stand_anywhere(flag, level):
    log = logging.getLogger("langsplat")
    for words in ([flag, "doctor"], ["doctor", flag]):
        log.setLevel(logging.INFO)
        parse(words)
        assert logging.getLevelName(log.level) == level
    log.setLevel(logging.INFO)
    viewer_parse([flag, "scene.ply"])
    assert logging.getLevelName(log.level) == level
    parse(["doctor"])
    assert log.level == logging.INFO


COMPLETE = """
source /dev/stdin
try() {
  COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1))
  _tyro_langsplat langsplat "${@: -1}"
  echo "${COMPREPLY[@]}"
}
try langsplat q
try langsplat train --max
try langsplat train --preset g
"""


def test_bash_completes_and_doctor_names_what_there_is(capsys):
    with pytest.raises(SystemExit) as stop:
        parse(["--tyro-print-completion", "bash"])
    assert not stop.value.code
    script = capsys.readouterr().out
    terminal = {**os.environ, "LC_ALL": "C.UTF-8", "PYTHONUTF8": "1"}  # of others tyro's scripts know nothing
    said = subprocess.check_output(["bash", "-c", COMPLETE], input=script, encoding="utf-8", env=terminal)
    assert said.splitlines() == ["query", "--max-relevancy-error", "good"]
    for word in ("help", "--help"):
        with pytest.raises(SystemExit):
            parse([word, "train"])
        assert "--preset" in capsys.readouterr().out
    Doctor().run()
    said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert said["langsplat"] == __version__
    assert said["OpenGL"]
    assert "demo: works" in said["text"]


@pytest.mark.long
def test_doctor_tries_an_encoder_on_the_bundled_room(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(encoder_check, "VIEWS", 3)
    monkeypatch.setattr(encoder_check, "MOST", 20)
    assert run("doctor", "--encoder", "demo", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["machine"]["langsplat"] == __version__
    geometry = said["geometry"]
    assert set(geometry) == set(encoder_check.GEOMETRY)
    assert geometry["own"][0] > geometry["other"][0] + 0.1
    things = said["rates"][0]
    assert things["found"] + things["rejected"] > 1.3
    assert said["calibration"]["thing"]["whole"] > 0
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    tiny_clip(tmp_path / "tiny")  # of random weights, which tell nothing apart
    monkeypatch.setattr(encoder_check, "MOST", 9)
    assert run("doctor", "--encoder", tmp_path / "tiny", "--calibrate") == 2
    printed = capsys.readouterr()
    assert encoder_check.GEOMETRY["alike"][0] in printed.out
    assert "ten phrases" in printed.err
    assert "demo" in refusal(capsys, "doctor", "--encoder", "demo", "--calibrate")
    assert not (tmp_path / "config").exists()


@pytest.mark.long
def test_demo_renders_the_bundled_scene_and_opens_its_page(tmp_path, monkeypatch, capfd):
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda page: opened.append(page) or True)
    monkeypatch.setenv("DISPLAY", ":987")
    assert run("demo", "--out", tmp_path) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"blue_gift.png", "room.html"}
    assert "'blue gift': found" in capfd.readouterr().out
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert run("demo", "--out", tmp_path) == 2
    assert opened == [(tmp_path / "room.html").as_uri()]  # once: without a screen there is no browser


# Odd values for every option and place of every command: refused in a line, or used.

ODD = ("1e-320", "1e308", "nan", "inf", "-inf", "-1", "0", "1000000", "", "x" * 5000, "\udcff", "0,0", "٣")
LINES = {  # words that work: positions, and options; what would take long ends where its files are looked for
    "viewer": "s.ply -- --headless --out o.png --size 32x24 --backend cpu",
    "train": "absent -- --out o.ply",
    "query": "s.ply gift --",
    "describe": "s.ply -- --vocabulary v.txt",
    "select": "s.ply gift -- --out o.ply",
    "teach": "s.ply -- --name mine --at 20,20 --into w.safetensors",
    **dict.fromkeys(("scale", "inspect", "serve"), "s.ply --"),
    "transform": "s.ply o.ply --",
    "crop": "s.ply o.ply -- --box -9 -9 -9 9 9 9",
    "export": "s.ply o.html --",
    "convert": "s.ply o.ply --",
    "doctor": "--",
    "demo": "-- --out s.ply/demo",
    "find": "gift . --",
    "changes": "s.ply t.ply --",
    "map": "s.ply m -- --metres-per-unit 1 --robot-height 2 --resolution 0.1",
    "mesh": "s.ply m.ply -- --views 3",
    "register": "s.ply t.ply --",
    "merge": "s.ply t.ply -- --out o.ply --as-is",
    "clean": "s.ply o.ply -- --views 2",
    "compact": "s.ply -- --out o.ply --views 2",
    **{f"eval {one}": "s.ply . --" for one in ("lerf-ovs", "3d-ovs", "gr-lerf")},
    "bench raster": "-- --scenes absent.ply --out b",
}


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with every sixtieth Gaussian of the bundled scene, larger, in two files, and a vocabulary."""
    folder, scene = tmp_path_factory.mktemp("corner"), load_scene(DEMO)
    few = scene.take(np.arange(0, len(scene.gaussians), 60))
    larger = few.gaussians.log_scales + np.float32(np.log(60) / 2)
    cameras = tuple(camera.resized(64, 48) for camera in few.cameras[:4])
    for name in ("s.ply", "t.ply"):
        made = replace(few, gaussians=replace(few.gaussians, log_scales=larger), cameras=cameras)
        save_scene(folder / name, replace(made, path=None))
    (folder / "v.txt").write_text("gift\nwood\n")
    return folder


@pytest.mark.parametrize("name", EVERY)
def test_every_number_of_every_command_has_a_range(name):
    command = parsed_as(name, LINES[name].replace("--", "", 1).split())
    without = {option for option, _, hint in numeric_settings(command) if range_of(hint) is None}
    assert without <= {"--rotate", "--start"}  # refused where they are used
    check_settings(command)


WITH_OUT = [name for name, kind in EVERY.items() if "out" in {*dir(kind), *kind.__dataclass_fields__}]


@pytest.mark.parametrize("name", WITH_OUT)
def test_every_output_may_be_named_by_out_or_o(name):
    whole = LINES[name].replace("--", "", 1).split()
    words = [word for word in whole if word not in ("--out", str(parsed_as(name, whole).out))]
    for given in (["--out", "new.ply"], ["--out=new.ply"], ["-o", "new.ply"]):
        for line in ([*words, *given], [*given, *words]):
            assert parsed_as(name, line).out == Path("new.ply")


def odd_places(name: str) -> Iterator[tuple[list[str], list[str], int]]:
    """Yield the words before and behind each place of a command line, and how many stand there."""
    first, _, last = LINES[name].partition("--")
    words, more = first.split(), last.split()
    for place in range(len(words)):
        yield words[:place], [*words[place + 1 :], *more], 1
    for action in get_parser(EVERY[name])._actions:  # noqa: SLF001
        if action.option_strings and action.nargs != 0:
            counts = {"between": 6, "matrix": 16, "start": 2, "heat-scale": 2}
            count = int(action.nargs) if str(action.nargs).isdigit() else counts.get(action.dest, 1)
            yield [*words, *more, action.option_strings[-1]], [], count


@pytest.mark.parametrize(
    "every", [pytest.param(False, marks=pytest.mark.long), pytest.param(True, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", EVERY)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_odd_values_are_refused_in_a_line_or_used(name, every, corner, tmp_path, monkeypatch):
    """In each place one that is drawn or, in the slow tier, all of them."""
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    rng = np.random.default_rng(len(name))
    begin, used = (viewer_parse, []) if name == "viewer" else (parse, name.split())
    for number, (before, behind, count) in enumerate(odd_places(name)):
        for odd in ODD if every else [str(rng.choice(ODD))]:
            folder = tmp_path / str(number)
            shutil.copytree(corner, folder, dirs_exist_ok=True)
            line = ["-q", *used, *before, *[odd] * count, *behind]
            said = io.StringIO()
            with warnings.catch_warnings(record=True) as warned, contextlib.chdir(folder):
                warnings.simplefilter("always", RuntimeWarning)
                with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(said):
                    code = main(name, lambda line=line: begin(line))
            errors = said.getvalue().splitlines()
            assert (code, len(errors)) in ((0, 0), (0, 1), (2, 1)), (line, code, errors)
            assert all(text.isprintable() and len(text) <= 1100 for text in errors), line
            assert [str(one.message) for one in warned if one.category is RuntimeWarning] == [], line
            shutil.rmtree(folder)


# Endings.

RUN = [sys.executable, "-m", "langsplat_core"]
WRITING = [
    "train d --out {}.ply",
    "train d --out s.ply --work {}",
    "select s.ply cup --out {}.ply",
    "convert s.ply {}.ply",
    "compact s.ply --out {}.ply",
    "demo --out {}",
    *(f"eval {one} s.ply d --json {{}}.json" for one in ("lerf-ovs", "3d-ovs", "gr-lerf")),
    "bench raster --out {}",
]


@pytest.mark.parametrize("line", WRITING)
@pytest.mark.parametrize("place", ["/proc/x", "{here}/file/x", "{here}/" + "n" * 300])
def test_commands_try_the_place_to_write_first(line, place, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "s.ply").symlink_to(DEMO)
    message = refusal(capsys, *line.format(place.format(here=tmp_path)).split())
    assert any(word in message for word in ("system's own", "is a file", "choose another")), message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "s.ply"]


def test_names_that_are_not_utf_8_are_printed_with_escapes(tmp_path: Path) -> None:
    scene = tmp_path / os.fsdecode(b"caf\xe9.ply")
    scene.symlink_to(DEMO)
    done = subprocess.run([*RUN, "scale", str(scene)], capture_output=True, text=True, check=True)
    printed = scene.name.encode("utf-8", "backslashreplace").decode()  # a letter where names are Latin-1
    assert f"{printed}: " in done.stdout


REPORTS = """
import logging, sys
from dataclasses import dataclass
from langsplat_core.cli.run import main, parsed
from langsplat_core.progress import TerminalProgress
@dataclass(frozen=True)
class Reports:
    def run(self):
        for progress in (TerminalProgress(lines=True), TerminalProgress()):
            with progress as report:
                report("working", 0.5)
        logging.getLogger("langsplat").warning("a warning")
        logging.getLogger("langsplat").debug("a detail")
        print("the answer")
sys.exit(main("reports", lambda: parsed("reports", Reports, sys.argv[1:])))
"""
SHELL = f"""
set -o pipefail
langsplat() {{ "{sys.executable}" -m langsplat_core "$@"; }}
langsplat-viewer() {{ "{sys.executable}" -m langsplat_viewer "$@"; }}
reports() {{ "{sys.executable}" -c "$REPORTS" "$@"; }}
"""


def in_a_shell(line: str) -> subprocess.CompletedProcess[str]:
    surroundings = os.environ | {"REPORTS": REPORTS}
    words = ["bash", "-c", SHELL + line]
    return subprocess.run(words, capture_output=True, text=True, check=False, env=surroundings)


@pytest.mark.long
@pytest.mark.parametrize(
    ("line", "code", "printed", "said"),
    [
        ("langsplat bench --help | head -1 >/dev/null", 0, 0, 0),
        (f"langsplat inspect {DEMO} --json | true", 0, 0, 0),
        (f"langsplat inspect {DEMO} >/dev/full", 2, 0, 1),
        ("langsplat train --help >/dev/full", 2, 0, 1),
        ("langsplat --version >&-", 2, 0, 1),
        ("langsplat query 2>&-", 2, 0, 0),
        ("langsplat-viewer absent.ply 2>/dev/full", 2, 0, 0),
        ("reports -v 2>/dev/full", 0, 1, 0),
        ("reports -v 2>&-", 0, 1, 0),
        ("reports -q >/dev/full", 2, 0, 1),
    ],
)
def test_closed_and_full_outputs_end_in_a_line(line: str, code: int, printed: int, said: int) -> None:
    done = in_a_shell(line)
    assert (done.returncode, done.stdout.count("\n"), done.stderr.count("\n")) == (code, printed, said)
    assert not said or "standard output cannot be written" in done.stderr


@pytest.mark.long
def test_verbosity_chooses_messages() -> None:
    quiet, plain, verbose = (in_a_shell(f"reports {flag}") for flag in ("-q", "", "-v"))
    assert {how.stdout for how in (quiet, plain, verbose)} == {"the answer\n"}
    assert quiet.stderr == ""
    assert '"fraction"' in plain.stderr
    assert "100%" in plain.stderr
    assert plain.stderr.endswith("\na warning\n")
    assert "a warning\na detail\nreports " in verbose.stderr


def signalled(code: str, number: int, seconds: float = 0.0) -> tuple[int, list[str]]:
    """The exit code and the errors of Python with `code`, sent a signal so long after it said "ready"."""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        time.sleep(seconds)
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    return process.returncode, errors.splitlines()


ENDED = pytest.mark.parametrize(
    ("number", "said"), [(signal.SIGTERM, "terminated"), (signal.SIGINT, "interrupted")]
)
CONTINUES = "langsplat: {}; the same command goes on from what was finished"


@ENDED
def test_a_signal_ends_a_command_in_a_line(number: int, said: str, tmp_path: Path) -> None:
    """With pycolmap imported, whose library would print a stack trace."""
    code = (
        "import signal, sys, time\nfrom langsplat_core.cli.run import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which a shell's background ignores
        "from dataclasses import dataclass\n"
        "@dataclass\nclass Waits:\n    def run(self):\n"
        "        import langsplat_core.datasets.reconstruction\n"
        "        print('ready', flush=True)\n"
        "        while True:\n            time.sleep(0.05)\n"  # a long sleep could begin after the signal
        "sys.exit(main('langsplat', Waits))\n"
    )
    assert signalled(code, number) == (128 + number, [CONTINUES.format(said)])


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.parametrize("program", ["langsplat_core", "langsplat_viewer"])
@pytest.mark.parametrize("seconds", [0.0, 0.2])
def test_a_signal_before_the_command_is_a_line(program: str, number: int, seconds: float) -> None:
    code = (
        "import signal, sys\nfrom langsplat_core.interrupts import end_in_a_line\n"
        f"from {program}.__main__ import entry\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "end_in_a_line('begins')\nprint('ready', flush=True)\nsys.argv = ['x', '--help']\nentry()\n"
    )
    ended, lines = signalled(code, number, seconds)
    assert ended == 128 + number or (ended == 0 < seconds)  # it was done before
    assert len(lines) == 1 or ended == 0, lines


CALLBACK = """import time; from ctypes import CFUNCTYPE, c_int
        names = {"__name__": "numba.core.codegen"}
        exec("import signal\\ndef call():\\n    signal.raise_signal(NUMBER)\\n    return 1", names)
        CFUNCTYPE(c_int)(names["call"])()
        while True: time.sleep(0.05)"""


@ENDED
@pytest.mark.parametrize("does", ["import heavy", CALLBACK])
def test_a_signal_in_foreign_code_ends_the_command(number: int, said: str, does: str, tmp_path: Path) -> None:
    """As pycolmap, which makes another error of any, torch, which swallows some, and LLVM, which drops it."""
    module = f"import os\ntry:\n    os.kill(os.getpid(), {int(number)})\nexcept BaseException:\n    pass\n"
    (tmp_path / "heavy.py").write_text(module)
    code = (
        "import signal, sys\nfrom langsplat_core.cli.run import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from dataclasses import dataclass\n@dataclass\nclass Imports:\n"
        f"    def run(self):\n        {does.replace('NUMBER', str(int(number)))}\n"
        f"sys.path.append({str(tmp_path)!r})\nsys.exit(main('langsplat', Imports))\n"
    )
    words = [sys.executable, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (128 + number, CONTINUES.format(said) + "\n")
