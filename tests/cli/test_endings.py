"""Whatever happens to a command, it ends with one line."""

import json
import os
import signal
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

from langsplat_core.cli.app import COMMANDS, GROUPS, parse
from langsplat_core.cli.checks import Written
from langsplat_core.cli.run import main
from langsplat_core.config import annotations, named_values
from tests.support.another_user import bound_by_permissions
from tests.support.sinks import SINKS, Case, Ended, run_all

DEMO = str(files("langsplat_assets") / "demo" / "scene.ply")
RUN = [sys.executable, "-m", "langsplat_core"]
WRITING = [
    "train d --out {}.ply",
    "train d --out s.ply --work {}",
    "select s.ply cup --out {}.ply",
    "convert s.ply {}.ply",
    "convert s.ply {} --to langsplat",
    "compact s.ply --out {}.ply",
    "demo --out {}",
    "eval lerf-ovs s.ply d --json {}.json",
    "eval 3d-ovs s.ply d --pictures {}",
    "eval scannet s.ply d --json {}.json",
    "bench raster --out {}",
    "bench query s.ply --out {}",
]
NOT_MARKED = {"convert s.ply {}.ply", "convert s.ply {} --to langsplat"}


@pytest.mark.parametrize("line", WRITING)
@pytest.mark.parametrize("place", ["/proc/x", "{here}/file/x", "{here}/" + "n" * 300])
def test_every_command_that_writes_tries_the_place_first(
    line: str, place: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    (tmp_path / "s.ply").symlink_to(DEMO)
    words = line.format(place.format(here=tmp_path)).split()
    assert main("langsplat", lambda: parse(words)) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert any(word in message for word in ("system's own", "is a file", "file system takes")), message
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "s.ply"]


@pytest.mark.parametrize("line", [line for line in WRITING if line not in NOT_MARKED])
def test_what_is_written_is_marked(line: str) -> None:
    command = parse(line.format("out").split())
    for option, _, hint in named_values(command):
        if option in ("--out", "--work", "--fit", "--pictures") or (
            option == "--json" and "Path" in str(hint)
        ):
            assert any(isinstance(part, Written) for part in annotations(hint)), option


@pytest.mark.parametrize(
    "words", [["query", DEMO, "caf\udce9"], ["query", DEMO, "cup", "--encoder", "\udcff"]]
)
def test_texts_that_are_not_utf_8(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main("langsplat", lambda: parse(words)) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert "is not UTF-8" in message


def test_a_name_that_is_not_utf_8_can_be_read_and_is_printed_with_escapes(tmp_path: Path) -> None:
    scene = tmp_path / os.fsdecode(b"caf\xe9.ply")
    scene.symlink_to(DEMO)
    done = subprocess.run([*RUN, "scale", str(scene)], capture_output=True, text=True, check=True)
    printed = scene.name.encode("utf-8", "backslashreplace").decode()  # a letter where names are Latin-1
    assert f"{printed}: " in done.stdout


@pytest.mark.parametrize("name", ["x" * 300 + ".ply", "file/x.ply", "/proc/self/mem"])
def test_names_that_cannot_be_read(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    for words in (["inspect", name], ["train", name, "--out", "s.ply", "--clip.model", "demo"]):
        assert main("langsplat", lambda words=words: parse(words)) == 2  # type: ignore[misc]
        assert len(capsys.readouterr().err.splitlines()) == 1


LINES = [
    "langsplat",
    "langsplat --version",
    "langsplat bench",
    "langsplat query",
    "langsplat scale absent.ply",
    f"langsplat scale {DEMO}",
    f"langsplat inspect {DEMO} --json",
    "langsplat-viewer --help",
    "langsplat-viewer --version",
    "langsplat-viewer --tyro-print-completion zsh",
    "langsplat-viewer absent.ply",
    "reports",
    "reports -q",
]
HELP = [
    f"langsplat {name} --help"
    for name in (
        "",
        *COMMANDS,
        *GROUPS,
        *(f"{group} {name}" for group in GROUPS for name in GROUPS[group][1]),
    )
]


@pytest.fixture(scope="module")
def ended() -> dict[Case, Ended]:
    cases = [Case(tuple(line.split()), out=sink) for line in LINES for sink in SINKS]
    cases += [Case(tuple(line.split()), err=sink) for line in LINES for sink in SINKS[1:]]
    cases += [Case(tuple(line.split()), out=sink) for line in HELP for sink in SINKS[1:3]]
    return run_all([*cases, Case(("reports", "-v"))])


def is_refusal(code: int, said: str) -> bool:
    return code == 2 and said.count("\n") == 1 and "standard output cannot be written" in said


@pytest.mark.long
@pytest.mark.parametrize("line", LINES)
def test_output_that_nobody_takes(line: str, ended: dict[Case, Ended]) -> None:
    words = tuple(line.split())
    plain = ended[Case(words)]
    assert plain.out or plain.err
    for sink in SINKS[1:]:
        lost = ended[Case(words, out=sink)]
        assert lost.out == ""
        if not plain.out:
            assert lost == plain
        elif sink == "closed pipe":
            assert lost == Ended(0, "", plain.err)
        else:
            assert is_refusal(lost.code, lost.err.removeprefix(plain.err))


@pytest.mark.long
@pytest.mark.parametrize("line", LINES)
def test_errors_that_nobody_takes_change_nothing_else(line: str, ended: dict[Case, Ended]) -> None:
    words = tuple(line.split())
    plain = ended[Case(words)]
    for sink in SINKS[1:]:
        assert ended[Case(words, err=sink)] == Ended(plain.code, plain.out, "")


@pytest.mark.long
def test_how_much_is_said(ended: dict[Case, Ended]) -> None:
    quiet, plain, verbose = (ended[Case(("reports", *flags))] for flags in (["-q"], [], ["-v"]))
    assert {how.out for how in (quiet, plain, verbose)} == {"the answer\n"}
    assert quiet.err == ""
    assert '"fraction"' in plain.err
    assert "50%" in plain.err
    assert plain.err.endswith("\na warning\n")
    assert "a warning\na detail\nreports " in verbose.err


@pytest.mark.long
@pytest.mark.parametrize("line", HELP)
def test_help_that_nobody_takes(line: str, ended: dict[Case, Ended]) -> None:
    words = tuple(line.split())
    assert ended[Case(words, out="closed pipe")] == Ended(0, "", "")
    full = ended[Case(words, out="full device")]
    assert is_refusal(full.code, full.err)


@pytest.mark.parametrize(
    ("command", "code", "lines"),
    [
        ("langsplat bench --help | head -1 >/dev/null", 0, 0),
        (f"langsplat scale {DEMO} | true", 0, 0),
        ("langsplat train --help >/dev/full", 2, 1),
        ("langsplat --version >&-", 2, 1),
        ("langsplat query 2>&-", 2, 0),
        ("langsplat query 2>/dev/full", 2, 0),
    ],
)
def test_a_shell_sees_the_same(command: str, code: int, lines: int) -> None:
    function = f'langsplat() {{ "{sys.executable}" -m langsplat_core "$@"; }}; set -o pipefail; '
    done = subprocess.run(["bash", "-c", function + command], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (code, "", lines)


@pytest.mark.parametrize(("number", "said"), [(signal.SIGTERM, "terminated"), (signal.SIGINT, "interrupted")])
def test_a_signal_ends_a_command_in_a_line(number: int, said: str, tmp_path: Path) -> None:
    """With pycolmap imported, whose library would print a stack trace."""
    code = (
        "import signal, sys, time\nfrom langsplat_core.cli.run import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # which a shell's background ignores
        "from dataclasses import dataclass\n"
        "@dataclass\nclass Waits:\n    def run(self):\n"
        "        from langsplat_core.datasets import load_capture\n"
        "        print('ready', flush=True)\n        time.sleep(60)\n"
        "sys.exit(main('langsplat', Waits))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    (line,) = errors.splitlines()
    assert line == f"langsplat: {said}; the same command continues where it stopped"


CLOSED = (".", "images", "sparse/0/cameras.bin", "transforms.json")
TRAIN_ALL = """
import json, sys
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
for words in json.load(sys.stdin):
    print(main("langsplat", lambda: parse(words)), flush=True)
"""


@pytest.mark.long
def test_datasets_that_may_not_be_read(tmp_path: Path) -> None:
    """One process tries them all: to be bound by permissions it has to be one of its own."""
    lines, paths = [], []
    for number, closed in enumerate(CLOSED):
        data = tmp_path / str(number)
        data.mkdir()
        if closed == "transforms.json":
            (data / closed).write_text("{}")
        else:
            (data / "images").mkdir()
            (data / "sparse" / "0").mkdir(parents=True)
            for name in ("cameras.bin", "images.bin", "points3D.bin"):
                (data / "sparse" / "0" / name).write_bytes(bytes(8))
        paths.append(data / closed)
        lines.append(["train", str(data), "--out", str(tmp_path / f"{number}.ply"), "--clip.model", "demo"])
    for path in paths:
        path.chmod(0)
    done = subprocess.run(
        [sys.executable, "-c", TRAIN_ALL],
        input=json.dumps(lines),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=bound_by_permissions(),
    )
    for path in paths:
        path.chmod(0o755)
    assert done.stdout.split() == ["2"] * len(CLOSED), done.stderr
    said = done.stderr.splitlines()
    assert len(said) == len(CLOSED), said
    assert all(line.startswith("langsplat: ") for line in said)
