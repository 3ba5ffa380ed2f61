"""The command line as a whole: its commands, their options, and what it says of those that do not exist."""

import dataclasses
import logging
import os
import subprocess
import sys

import pytest
from tyro.extras import get_parser

from langsplat_core import __version__
from langsplat_core.cli import scenes
from langsplat_core.cli.app import COMMANDS, GROUPS, entry, load_command, parse
from langsplat_core.cli.run import main
from langsplat_core.cli.scenes import Doctor
from langsplat_core.errors import InputError
from langsplat_viewer.program import ViewerCommand
from langsplat_viewer.program import entry as viewer_entry
from langsplat_viewer.program import parse as viewer_parse

EVERY = {
    "viewer": ViewerCommand,
    **{name: load_command(where) for name, where in COMMANDS.items()},
    **{f"{group} {name}": load_command(at) for group in GROUPS for name, at in GROUPS[group][1].items()},
}


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_every_option_is_described(name):
    actions = get_parser(EVERY[name])._actions  # noqa: SLF001  argparse has no public list of them
    assert len(actions) > len(dataclasses.fields(EVERY[name])) // 2
    bare = [
        action.dest
        for action in actions
        if len((action.help or "").partition("(default")[0].replace("(required)", "").strip()) < 3
    ]
    assert bare == []


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["qurey", "a.ply"], "no command 'qurey'; did you mean 'query'?"),
        (["bench", "quary"], "no command 'bench quary'; did you mean 'query'?"),
        (["xyz"], "no command 'xyz'; there are train, frames, query"),
    ],
)
def test_a_command_that_does_not_exist_is_named(words, said):
    with pytest.raises(InputError) as error:
        parse(words)
    assert str(error.value).startswith(said)


@pytest.mark.parametrize(("program", "run"), [("langsplat", entry), ("langsplat-viewer", viewer_entry)])
def test_versions(program, run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [program, "--version"])
    with pytest.raises(SystemExit) as stop:
        run()
    assert not stop.value.code
    assert capsys.readouterr().out == f"{program} {__version__}\n"


@pytest.mark.parametrize(("flag", "level"), [("-q", "ERROR"), ("--verbose", "DEBUG")])
def test_how_much_is_said_stands_anywhere(flag, level):
    log = logging.getLogger("langsplat")
    for words in ([flag, "doctor"], ["doctor", flag], ["bench", flag, "raster"], ["bench", "raster", flag]):
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
try langsplat bench r
try langsplat train --max
try langsplat train --preset g
"""


def test_bash_completes_commands_options_and_choices(capsys):
    with pytest.raises(SystemExit) as stop:
        parse(["--tyro-print-completion", "bash"])
    assert not stop.value.code
    script = capsys.readouterr().out
    terminal = {**os.environ, "LC_ALL": "C.UTF-8", "PYTHONUTF8": "1"}  # of others tyro's scripts know nothing
    done = subprocess.run(
        ["bash", "-c", COMPLETE],
        input=script,
        capture_output=True,
        encoding="utf-8",
        check=True,
        env=terminal,
    )
    assert done.stdout.splitlines() == ["query", "raster", "--max-relevancy-error", "good"]


def test_a_shell_without_completion_is_named():
    with pytest.raises(InputError, match="--tyro-print-completion ksh: there is bash, zsh"):
        parse(["--tyro-print-completion", "ksh"])


def test_doctor_says_what_draws_and_what_encodes(capsys):
    Doctor().run()
    said = dict(line.split(maxsplit=1) for line in capsys.readouterr().out.splitlines())
    assert said["langsplat"] == __version__
    assert said["OpenGL"]
    assert "demo: works" in said["text"]


@pytest.mark.long
def test_demo_renders_the_bundled_scene(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(scenes, "PICTURES", {"gift.png": ("--query", "blue gift")})
    assert main("langsplat", lambda: parse(["demo", "--out", str(tmp_path)])) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["gift.png"]
    assert "'blue gift': found" in capfd.readouterr().out
    monkeypatch.setattr(scenes, "PICTURES", {"gift.png": ("--camera", "absent")})
    assert main("langsplat", lambda: parse(["demo", "--out", str(tmp_path)])) == 2
