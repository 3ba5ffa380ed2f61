"""What every layer shares: numbers, messages, progress, kernels, extensions, settings, options of `train`."""

import dataclasses
import math
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from importlib.metadata import EntryPoint
from itertools import product
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numba
import numpy as np
import pytest

from langsplat_core import compiled, config, errors, registry
from langsplat_core.arrays import psnr, quaternions, rotation_matrices, unit
from langsplat_core.cli.app import CORE, command_names, parse
from langsplat_core.cli.train import Train
from langsplat_core.compiled import Workers, is_compiled
from langsplat_core.config import PAPER, annotations, check_settings, range_of
from langsplat_core.errors import EncoderError, InputError, printable_line, quoted
from langsplat_core.io.scenes import CORE_FORMATS, Exporter, Importer, SceneFormat, load_scene, save_scene
from langsplat_core.progress import Progress, Report, TerminalProgress, TimeLeft
from langsplat_core.scene import Scene
from langsplat_core.semantics import encoders, sam
from langsplat_viewer.panels.layout import CORE_PANELS
from tests.support.fakes import numeric_settings
from tests.support.processes import files_of_at_most, python, refusal, run
from tests.support.scenes import random_gaussians


def test_quaternions_of_rotations() -> None:
    """Any turn, half turns about axes and diagonals, turns too small to be seen."""
    given = np.random.default_rng(0).normal(size=(300, 4))
    given[:100] *= (1e-9, 1, 1, 1)
    given[100:200] *= (1, 1e-9, 1e-9, 1e-9)
    given[200:215] = list(product((0, 1), repeat=4))[1:]
    turns = rotation_matrices(given)
    got = quaternions(turns.reshape(3, 100, 3, 3)).reshape(-1, 4)
    assert (got[:, 0] >= 0).all()
    np.testing.assert_allclose(np.abs((got * unit(given)).sum(1)), 1, rtol=1e-14)
    np.testing.assert_allclose(rotation_matrices(got), turns, atol=1e-14)


def test_psnr() -> None:
    a = np.zeros((4, 4, 3), np.float32)
    assert psnr(a + np.float32(0.1), a) == pytest.approx(20, abs=1e-5)
    assert psnr(a, a) == 100
    assert psnr(a.astype(np.float16) + 1, a) == pytest.approx(0)


# Messages.


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("one\n  two\r\n\tthree", "one two three"),
        ("a\x1b[2Jb\x00c\x7f", r"a\x1b[2Jb\x00c\x7f"),
        ("\udcff surrogate", r"\udcff surrogate"),
        ("right\u202eleft", r"right\u202eleft"),
        ("Tür \u2028 é 日本", "Tür é 日本"),
        ("", ""),
    ],
)
def test_one_printable_line(text: str, line: str) -> None:
    kinds = InputError, errors.FormatError, errors.BackendError, EncoderError
    assert {printable_line(text), *(str(kind(text)) for kind in kinds)} == {line}


def test_a_long_line_keeps_its_ends() -> None:
    line = printable_line("begin " + "x" * 10_000 + " end", 100)
    assert len(line) == 100
    assert line.startswith("begin xxx")
    assert line.endswith("xxx end")
    assert len(str(InputError("y" * 10_000))) == errors.LINE_LIMIT
    assert printable_line("z" * 100, 100) == "z" * 100
    assert len(quoted("\x00" * 60, 60)) == 60


# Progress.


def test_progress_as_lines_for_other_programs(capsys):
    with TerminalProgress(lines=True) as progress:
        progress("a\n", 0.25, "one", loss=0.25)
        progress("a\n", 0.2501, "one", loss=0.250001)
        progress("b", 7.0)
    reports = [Report.from_json(line) for line in capsys.readouterr().err.splitlines()]
    assert reports == [Report("a\n", 0.25, "one", {"loss": 0.25}), Report("b", 1.0)]
    assert reports[0].text == "a\n: one, loss 0.2500"
    assert Report("a", 0.5, "b", {"psnr": 20.06}).text == "a: b, held-out PSNR 20.1 dB"
    for line in ("words", '{"stage": 3}', '"text"', "[1]", '{"stage": "a", "fraction": 0, "metrics": 1}'):
        with pytest.raises(ValueError):
            Report.from_json(line)


@pytest.mark.parametrize("stopped", [False, True])
def test_bars_of_finished_stages_are_full(stopped: bool, capsys: pytest.CaptureFixture[str]) -> None:
    """A stage may end before its last report; one that was stopped did not end."""
    with suppress(KeyboardInterrupt), TerminalProgress() as report:
        for stage in ("matching", "locating", "locating"):
            report(stage, 0.3)
        if stopped:
            raise KeyboardInterrupt
    shares = [line.split()[-2] for line in capsys.readouterr().err.splitlines() if "%" in line]
    assert shares == (["100%", "30%"] if stopped else ["100%"] * 2)


@pytest.mark.parametrize(
    ("items", "kept"),
    [
        ([0.1] * 2_000, 0),
        ([20.0] * 12, 0),
        ([*[0.5] * 50, *[1.0] * 200], 0),  # other work begins beside it
        ([0.2 + 0.0005 * item for item in range(600)], 0),  # more to do in each
        ([*[0.001] * 600, *[1.0] * 400], 0),  # what an earlier run has done is passed
        ([0.5] * 400, 250),  # a run taken up begins amid its stage
    ],
)
def test_time_left_is_true_from_the_second_minute_on(items: list[float], kept: int) -> None:
    now, said = 0.0, 0
    left = TimeLeft(clock=lambda: now)
    for index, item in enumerate(items[kept:], kept):
        left.hear(index / len(items))
        now += item / 2
        seconds, truth = left.seconds(), sum(items[index:]) - item / 2
        assert str(left) != "0 s left"
        if seconds is not None and now > 60:
            said += 1
            assert abs(seconds - truth) <= 0.3 * truth + 2
        now += item / 2
    left.hear(1.0)
    assert said > len(items[kept:]) / 6
    assert (left.seconds(), str(left)) == (None, "")


def test_time_left_is_not_said_of_what_is_not_known() -> None:
    now = 0.0
    left = TimeLeft(clock=lambda: now)
    for fraction, seconds, said in (
        (0.0, 1.0, ""),
        (0.5, 0.5, ""),
        (0.75, 4.0, ""),  # of a second of work
        (0.1, 20.0, ""),
        (0.2, 20.0, "2 min left"),
        (0.3, 20.0, "2 min left"),  # it began again
        (0.4, 20.0, "100 s left"),
        (0.5, 20.0, "80 s left"),
        (0.6, 15.0, "65 s left"),
        (0.6, 9.0, "64 s left"),
        (0.6, 10.0, "74 s left"),
        (0.6, 40.0, ""),  # overdue
    ):
        left.hear(fraction)
        now += seconds
        assert str(left) == said, (fraction, seconds)


def test_progress_of_a_part_stays_within_its_share():
    reports: list[Report] = []
    whole = Progress(reports.append)
    whole.part(1, 4)("inner", 0.5, "b", loss=1.0)
    whole.part(3, 4, "outer", "c")("inner", 1.0)
    assert reports == [Report("inner", 0.375, "b", {"loss": 1.0}), Report("outer", 1.0, "c")]


# Machine code that is kept on disk never outlives the sources it was made from.

PACKAGE = Path(compiled.__file__).parent
KERNEL = """
from langsplat_core.arrays import Array
from langsplat_core.compiled import kernel
from langsplat_core.adding import added
@kernel
def run(first: int, last: int, out: Array) -> None:
    for i in range(first, last):
        out[i] = added(i)
"""
HELPER = (  # which allocates, as kernels do
    "from langsplat_core.compiled import helper\nN = {step}\n@helper\ndef added(i):\n    return sum([i, N])\n"
)
CALL = "import numpy as np; from langsplat_core.running import run; x = np.zeros(3); run(0, 3, x); print(x)"


def small_package(folder: Path) -> Path:
    """A package with one kernel, whose helper in `adding.py` is still to be written."""
    package = folder / "langsplat_core"
    package.mkdir()
    (package / "__init__.py").touch()
    for name in ("arrays.py", "compiled.py", "errors.py"):
        shutil.copy(PACKAGE / name, package / name)
    (package / "running.py").write_text(KERNEL)
    return package


@pytest.mark.long
def test_kernels_are_kept_until_a_helper_changes(tmp_path: Path) -> None:
    package = small_package(tmp_path)
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONPATH"] = str(tmp_path)
    code = f"{CALL}; from numba.core import runtime; print(len(run.stats.cache_misses), runtime.rtsys._init)"
    for step, said in ((1, "[1. 2. 3.]"), (5, "[5. 6. 7.]")):
        (package / "adding.py").write_text(HELPER.format(step=step))
        for compiled_now in ("1 True", "0 False"):  # what was kept runs without numba's compiled runtime
            command = [sys.executable, "-c", code]
            text = subprocess.check_output(command, env=environment, cwd=tmp_path, text=True)
            assert text.splitlines() == [said, compiled_now]
    assert len(list(package.rglob("*.nbc"))) == 1  # the code of the older sources is gone


@pytest.mark.long
@pytest.mark.parametrize("home", ["/proc", "closed"])
def test_kernels_compile_without_a_writable_folder(home: str, tmp_path: Path) -> None:
    """With neither the package's folder nor a home to write to."""
    package, closed = small_package(tmp_path), tmp_path / "closed"
    closed.mkdir()
    (package / "adding.py").write_text(HELPER.format(step=2))
    for folder in (package, closed):
        folder.chmod(0o555)
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(tmp_path), "PYTHONDONTWRITEBYTECODE": "1"}
    home_there = environment | {"HOME": str(tmp_path / home)}
    done = python("-c", CALL, env=home_there, cwd=tmp_path, bound=True)
    for folder in (package, closed):
        folder.chmod(0o755)
    assert done.stdout.strip() == "[2. 3. 4.]", done.stderr
    (line,) = done.stderr.splitlines()
    assert "kernels are compiled for this run only" in line


def test_pieces_cover_a_range_once() -> None:
    def mark(first: int, last: int, out: np.ndarray) -> None:
        out[first:last] += 1

    for count, threads in product((0, 1, 7, 100), (1, 3)):
        out = np.zeros(count, int)
        Workers(threads).run(mark, count, out)
        assert (out == 1).all()


def test_kernels_run_on_a_full_disk(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def doubled(value: float) -> float:
        return value + value

    for size in (0, 500):
        double = compiled.kernel(doubled)
        with files_of_at_most(size), caplog.at_level("WARNING", "langsplat"):
            assert double(2.5) == 5
    (said,) = caplog.messages
    assert said.startswith("kernels are compiled for this run only, which takes some seconds:")
    assert not list(tmp_path.rglob("*.nbc"))
    again = compiled.kernel(doubled)
    assert not is_compiled(again)
    assert again(2.5) == 5
    assert list(tmp_path.rglob("*.nbc"))
    assert is_compiled(compiled.kernel(doubled))


def test_kernels_are_the_same_through_a_link(tmp_path):
    """As those of an editable installation and of the source folder."""
    source, link = Path(compiled.__file__).parent / "raster" / "cpu", tmp_path / "link"
    link.symlink_to(source)
    assert compiled.digest_of_sources(link / "tiles.py") == compiled.digest_of_sources(source / "tiles.py")


def test_kernels_of_other_signatures_are_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that processes that begin at once cannot take one for the other."""

    def tripled(value: float) -> float:
        return 3 * value

    for value in (2.5, 2):
        monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / str(value)))
        assert compiled.kernel(tripled)(value) == 3 * value
    assert len({path.name for path in tmp_path.rglob("*.nbc")}) == 2


# Extensions: a stranger's package adds a format and a command, a broken one costs a warning.

EXAMPLE = Path(__file__).parents[1] / "docs" / "examples" / "05_write_an_extension"
OWN = sorted(registry.extensions())


def langsplat(site: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run `langsplat` with the packages in the folder `site` beside those that are installed."""
    paths = os.pathsep.join([str(site), *sys.path])
    return python("-m", "langsplat_core", *words, env={**os.environ, "PYTHONPATH": paths})


@pytest.fixture(scope="module")
def example(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that the example is installed into, as a user would."""
    folder = tmp_path_factory.mktemp("example")
    shutil.copytree(EXAMPLE, folder / "source")
    install = ["install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index"]
    target = ["--target", str(folder / "site"), str(folder / "source")]
    subprocess.run([sys.executable, "-m", "pip", *install, *target], check=True, capture_output=True)
    return folder / "site"


@pytest.mark.long
def test_installed_package_adds_a_format_and_a_command(example: Path, tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 255, (200, 6)).round(2)
    np.savetxt(tmp_path / "a.xyz", points)
    converted = langsplat(example, "convert", tmp_path / "a.xyz", tmp_path / "a.ply")
    assert (converted.returncode, converted.stderr) == (0, "")
    np.testing.assert_allclose(load_scene(tmp_path / "a.ply").gaussians.means, points[:, :3], rtol=1e-6)
    extent = langsplat(example, "extent", tmp_path / "a.ply")
    lengths = [float(word) for word in extent.stdout.split()[1:]]
    np.testing.assert_allclose(lengths, np.ptp(points[:, :3], axis=0), atol=1e-3)
    (tmp_path / "bad.xyz").write_text("one two three\n")
    refused = langsplat(example, "extent", tmp_path / "bad.xyz")
    assert refused.returncode == 2
    assert len(refused.stderr.splitlines()) == 1


@pytest.mark.long
@pytest.mark.parametrize(
    "code",
    [
        "raise RuntimeError('of\\nthe stranger')",
        "EXTENSION = 3",
        "from langsplat_core.registry import Extension\nEXTENSION = Extension(formats={'.x': 'none_such:F'})",
    ],
    ids=["raises", "is none", "names nothing"],
)
def test_broken_extension_costs_one_warning(code: str, tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(code)
    about = tmp_path / "broken-1.0.dist-info"  # an entry point of the group, as an installed package has it
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(f"[{registry.GROUP}]\nbroken = broken:EXTENSION\n")
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(20)))
    done = langsplat(tmp_path, "convert", tmp_path / "a.ply", tmp_path / "b.splat")
    assert done.returncode == 0
    assert (tmp_path / "b.splat").exists()
    (warning,) = done.stderr.splitlines()
    assert "left out" in warning


def test_broken_part_is_refused_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = registry.Extension(exporters={"broken": "none_such:EXPORTER"})
    monkeypatch.setattr(registry, "extensions", lambda: {"a": broken})
    assert registry.parts("exporters") == {}
    with pytest.raises(registry.InputError, match="broken"):
        registry.part("exporters", "broken")


def test_names_taken_and_misfits_are_said(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    """Two extensions of one name, parts of one, some the core's, no Exporter; a group without a sentence."""
    names = "hail", "greet one", "query", "doctor who"
    part = registry.Extension(commands=dict.fromkeys(names, "json:load"))
    exporters = {"odd": "json:load", "own": "two:C"}
    other = registry.Extension(commands={"hail": "json:dump"}, exporters=exporters)
    own = type("Own", (type("Exporter", (), {}),), {})()
    monkeypatch.setitem(sys.modules, "two", SimpleNamespace(A=part, B=other, C=own))
    points = [EntryPoint(name, f"two:{what}", registry.GROUP) for name, what in ("aA", "aB", "bB")]
    monkeypatch.setattr(registry, "entry_points", lambda group: points)
    monkeypatch.setattr(registry, "extensions", registry.extensions.__wrapped__)
    assert [*registry.extensions()] == ["a", "b"]
    twice = "extension a has it among its commands, too; LANGSPLAT_WITHOUT=a hides that"
    assert [line.partition(" is left out: ")[::2] for line in caplog.messages] == [
        ("extension a (two:B)", "two:A has its name"),
        ("'query' of extension a", "the core has it among its commands"),
        ("'doctor who' of extension a", "the core has it among its commands"),
        ("'hail' of extension b", twice),
    ]
    assert registry.part("exporters", "own") is own
    for kind, name in (("commands", "hail"), ("exporters", "odd")):
        with pytest.raises(InputError, match="cannot be used: its extension is broken"):
            registry.part(kind, name)
    assert caplog.messages[-1].endswith("json:load is no Exporter; see docs/extensions.md")
    with pytest.raises(InputError, match="no command 'greet two'; there are one"):
        parse(["greet", "two"])
    assert not registry.references("commands").keys() & {"query", "doctor who"}


def test_names_of_the_core_are_listed() -> None:
    own = {"commands": CORE, "encoders": encoders.FAMILIES, "formats": [row.suffix for row in CORE_FORMATS]}
    own |= {"segmenters": sam.FAMILIES, "text_segmenters": sam.TEXT_FAMILIES}
    own |= {"panels": [panel.title for panel in CORE_PANELS]}
    for kind, names in own.items():
        assert sorted(registry.OWN[kind].split()) == sorted(names)


def test_failing_part_is_one_line_that_names_its_extension(tmp_path, monkeypatch, capsys) -> None:
    def fails(*words: object) -> None:
        raise KeyError("gone")

    def nothing(*words: object) -> None: ...

    monkeypatch.chdir(tmp_path)
    empty = Importer((".few",), lambda *words: (None, ()))
    parts = SceneFormat(".odd", nothing, fails), Importer((".many",), nothing), empty, Exporter(nothing)
    odd = ModuleType("odd")
    exec("def layout(*words):\n raise KeyError('lost')", vars(odd))
    vars(odd).update(zip("fije", parts, strict=True))
    monkeypatch.setitem(sys.modules, "odd", odd)
    named = {"formats": {".odd": "odd:f"}, "exporters": {"files": "odd:e"}, "layouts": {"odd": "odd:layout"}}
    named |= {"importers": {"many": "odd:i", "few": "odd:j"}}
    monkeypatch.setattr(registry, "extensions", lambda: {"oddity": registry.Extension(**named)})
    save_scene("a.ply", Scene(random_gaussians(3)))
    for name in ("a.odd", "a.many", "a.few", "a.bin"):
        Path(name).touch()
    for words in ("a.odd b.ply", "a.many b.ply", "a.few b.ply", "a.ply b.odd", "a.ply b --to files"):
        assert "its extension's odd:" in refusal(capsys, "convert", *words.split())
    said = refusal(capsys, "doctor", "--encoder", "a.bin")
    assert "extension oddity fails in odd, line 2 (KeyError: 'lost')" in said
    assert run("-v", "doctor", "--encoder", "a.bin") == 2
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize("hidden", OWN)
def test_help_shows_the_rest_with_an_extension_hidden(hidden, monkeypatch, capsys):
    every = set(command_names())
    own = set(registry.extensions()[hidden].commands)
    monkeypatch.setenv(registry.HIDDEN, hidden)
    registry.extensions.cache_clear()
    try:
        assert set(command_names()) == every - own
        with pytest.raises(SystemExit):
            parse(["--help"])
        listed = capsys.readouterr().out
        assert "from extensions" not in listed  # each has another heading
        for name in every:
            assert (f"\n  {name} " in listed) == (name not in own and " " not in name)
    finally:
        registry.extensions.cache_clear()


# Settings: every number has a range, and what lies outside is refused by name, before any work.


CONFIGS = {
    name: value
    for name, value in vars(config).items()
    if dataclasses.is_dataclass(value) and isinstance(value, type) and value is not config.Range
}
SETTINGS = [
    (name, *setting)
    for name, cls in sorted(CONFIGS.items())
    for setting in numeric_settings(cls())
    if "." not in setting[0]  # those of configurations inside are met in their own class
]


def outside(own: Any, bound: config.Range, hint: Any) -> list[Any]:
    """Values that the range of a setting excludes, in the shape of its own value."""
    below = bound.low if bound.above else bound.low - 1
    values: list[Any] = [below, bound.high * 2 + 1, 10**400, math.nan, math.inf, -math.inf, "7"]
    if float not in annotations(hint):
        values.append(bound.low + 0.5)
    found: list[Any] = [shaped(own, value) for value in values]
    return found + ([()] if bound.some else [])


def shaped(like: Any, value: Any) -> Any:
    """`value` in the last place of a tuple such as `like`, or as it is."""
    return (*like[:-1], shaped(like[-1], value)) if isinstance(like, tuple) and like else value


@pytest.mark.parametrize(("name", "option", "own", "hint"), SETTINGS)
def test_numbers_outside_their_range_are_refused_by_name(name: str, option: str, own: Any, hint: Any) -> None:
    bound = range_of(hint)
    assert bound is not None, f"{name}: write Annotated[..., Range(...)] beside {option}"
    assert np.isfinite([bound.low, bound.high]).all()
    check_settings(CONFIGS[name]())
    field = option.removeprefix("--").replace("-", "_")
    for value in outside(own, bound, hint):
        wrong = dataclasses.replace(CONFIGS[name](), **{field: value})
        with pytest.raises(InputError) as caught:
            check_settings(wrong)
        message = str(caught.value)
        assert message.startswith(f"{option} "), message
        assert len(message) < 200


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("--radiance.sh-degree 4", "--radiance.sh-degree 4: must be 0 to 3"),
        ("--codec.kind linear --codec.latent-dim 0", "--codec.latent-dim 0: must be 1 to 4096"),
        ("--codec.kind vq", "--codec.kind: expected one of 'codebook', 'autoencoder', 'linear', not 'vq'"),
        ("--codec.steps 7", "--codec.steps: is no setting of a codec of kind codebook"),
        ("--codec.kind=linear --max_relevancy-error 1", "--codec.max-relevancy-error: is no setting of"),
    ],
)
def test_the_command_line_names_the_option_as_typed(line, named, tmp_path, capsys):
    error = refusal(capsys, "train", tmp_path, "--out", tmp_path / "s.ply", *line.split())
    assert error.lower().startswith(f"langsplat: {named}")
    assert list(tmp_path.iterdir()) == []  # nothing was begun


def test_settings_without_effect_are_said(tmp_path, capsys, caplog):
    words = "--dataset.frames 9 --lift.steps 5 --masks.sam x --masks.source graph --masks.nms-iou 0.5"
    refusal(capsys, "train", tmp_path, "--out", "s.ply", *words.split())
    assert caplog.messages[:3] == [
        "--dataset.frames: of no effect with photographs",
        "--masks.sam, --masks.nms-iou: of no effect with --masks.source graph",
        "--lift.steps: of no effect with --lift.mode median",
    ]
    assert "it is a folder" in refusal(capsys, "train", tmp_path, "--on", "local:1", "--out", "s.ply")


# How the options of `langsplat train` come together.

WORDS = ("train", "photographs", "--out", "s.ply")


PAGE = Path(__file__).parents[1] / "docs" / "photographs.md"


def trained(*words: str, file: Path | None = None, text: str = "") -> Train:
    """Return what is asked for, with a file that holds `text`."""
    if file is not None:
        file.write_text(text)
        words = (*words, "--config", str(file))
    found = parse([*WORDS, *words])
    assert isinstance(found, Train)
    assert found.dataset == (Path("photographs"),)
    return found


@pytest.mark.parametrize("name", ["--max-relevancy-error", "--codec.max-relevancy-error"])
def test_every_spelling_of_an_option_takes_its_value_both_ways(name: str) -> None:
    for spelling in (name, name.replace("-", "_").replace("__", "--", 1)):
        assert trained(f"{spelling}=0.002").config.codec.max_relevancy_error == 0.002
        assert trained(spelling, "0.002").config.codec.max_relevancy_error == 0.002


def test_options_beside_a_preset_win() -> None:
    found = trained("--radiance.steps=8", "--preset", "good", "--phrases", "red mug", "keyboard")
    assert (found.preset, found.config.radiance.steps) == ("good", 8)
    assert (found.config.dataset.max_side, found.config.radiance.max_gaussians) == (480, 60_000)
    assert found.config.phrases == ("red mug", "keyboard")
    paper = trained("--profile=paper", "--codec.latent-dim", "8").config
    assert paper == dataclasses.replace(PAPER, codec=dataclasses.replace(PAPER.codec, latent_dim=8))


def test_the_example_of_the_docs_is_read(tmp_path: Path) -> None:
    (example,) = PAGE.read_text().split("```toml\n")[1:]
    found = trained(file=tmp_path / "train.toml", text="\ufeff" + example.partition("```")[0])
    config = found.config
    assert (found.preset, config.radiance.max_gaussians) == ("good", 60_000)  # the preset's
    assert (config.radiance.steps, config.clip.model) == (3000, "demo")
    assert (config.codec.max_relevancy_error, config.phrases) == (0.002, ("blue gift", "keyboard"))


def test_options_beside_a_file_win(tmp_path: Path) -> None:
    file, text = tmp_path / "f.toml", 'preset = "quick"\nradiance.steps = 7\nphrases = ["a", "b"]'
    assert trained(file=file, text=text).config.radiance.steps == 7
    other = trained("--radiance.steps=8", "--preset", "good", "--phrases", "c", file=file, text=text)
    assert (other.preset, other.config.radiance.steps, other.config.phrases) == ("good", 8, ("c",))
    flags = "[dataset]\nallow_few_cameras = true"
    for words in ((), ("--dataset.no-allow-few-cameras",)):
        assert trained(*words, file=file, text=flags).config.dataset.allow_few_cameras is not bool(words)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[radiance]\nstepz = 7", "--radiance.stepz"),
        ("[radiance]\nsteps = 'many'", "--radiance.steps: expected a whole number"),
        ("[radiance]\nsteps = 0", "--radiance.steps 0: must be 1 to"),
        ("phrases = ['--out', 'x']", "phrases"),
        ("config = 'other.toml'", "config"),
        ("44 = 'quick'", "44"),
        ("steps = ", "Invalid value"),
        ("\x01", "cannot be used as --config"),
        (f"{'9' * 400} = 1", "is a number"),
        (None, "no such file"),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_its_key(text, said, tmp_path, capsys):
    file = tmp_path / "train.toml"
    if text is not None:
        file.write_text(text)
    line = refusal(capsys, *WORDS, "--config", file)
    assert line.startswith(f"langsplat: {file}: ")
    assert said in line
    assert len(line) <= len(str(file)) + 240


@pytest.mark.parametrize("said", [None, "ACTIVE"])
def test_threads_of_torch_do_not_spin_unless_asked_to(said):
    code = "import os, langsplat_core; print(os.environ['OMP_WAIT_POLICY'])"
    rest = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    own = {} if said is None else {"OMP_WAIT_POLICY": said}
    text = subprocess.check_output([sys.executable, "-c", code], env=rest | own, text=True)
    assert text.strip() == (said or "passive")
