"""What the pages say can be done: commands parse, the quick ones run, links lead somewhere, Python runs;
every script in `docs/examples` runs without arguments of its own, and says and draws what it promises."""

import json
import re
import runpy
import shlex
import shutil
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from assets.making.__main__ import parse as parse_making
from langsplat_core.cli.app import parse
from langsplat_core.cli.arguments import Runnable
from langsplat_core.cli.run import main
from langsplat_viewer.program import parse as parse_viewer
from tests.benchmarks.__main__ import parse as parse_benchmarks
from tests.support.scenes import DEMO

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES += (ROOT / "assets").rglob("*.md")
TOML = re.compile(r"^```toml\n(.*?)^```", re.MULTILINE | re.DOTALL)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


PARSERS: dict[str, Callable[[list[str]], Runnable]] = {
    "langsplat": parse,
    "langsplat-viewer": parse_viewer,
    "assets.making": parse_making,
    "tests.benchmarks": parse_benchmarks,
}


def block_lines(text: str) -> list[str]:
    """The lines of indented and fenced blocks, continued ones joined."""
    blocks = re.findall(r"^```(?:sh|bash|console)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    blocks += re.findall(r"((?:^    .*\n)+)", text, re.MULTILINE)
    joined = "\n".join(blocks).replace("\\\n", " ")
    return [line.strip() for line in joined.splitlines()]


def commands(text: str) -> list[list[str]]:
    """Every command of a page, in blocks and between backticks, split into words; program first."""
    spans = [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", PYTHON.sub("", text))]
    found = []
    for line in [*block_lines(text), *spans]:
        line = line.removeprefix(".venv/bin/").removeprefix("python -m ")
        program = line.split(" ")[0]
        if program in (*PARSERS, "make") and "..." not in line and " " in line:
            found.append([program, *shlex.split(line, comments=True)[1:]])
    return found


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_commands_parse(page, capsys, tmp_path, monkeypatch):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    monkeypatch.chdir(tmp_path)
    for settings in TOML.findall(page.read_text()):
        Path("train.toml").write_text(settings)
    for program, *words in commands(page.read_text()):
        if program == "make":
            assert words[0] in targets, words
        elif all(word.isalpha() and word.islower() for word in words):  # a command's name alone
            with pytest.raises(SystemExit) as stop:
                PARSERS[program]([*words, "--help"])
            assert stop.value.code in (0, None), words
        else:
            try:
                PARSERS[program](words)
            except SystemExit as stop:
                if stop.code:  # a completion script ends without
                    pytest.fail(f"{program} {shlex.join(words)}: {capsys.readouterr().err}")


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)\)", page.read_text())
    assert [t for t in targets if "://" not in t and not (page.parent / t).exists()] == []


@pytest.mark.long
def test_site_has_every_page() -> None:
    nav = (ROOT / "packaging" / "site" / "mkdocs.yml").read_text().split("\nnav:\n")[1]
    listed = set(re.findall(r"[\w/]+\.md", nav))
    own = {path.name for path in (ROOT / "packaging" / "site").glob("*.md")}
    assert listed - own - {"index.md", "pages.md"} == {p.name for p in ROOT.glob("docs/*.md")} - {"README.md"}


ROWS = re.compile(r"^\| ([a-z][^|]*) \| [a-z0-9][^|]*  [^|]* \|", re.MULTILINE)  # phrase, reading
SAID = re.compile(r"(?:such as|, as|, like|example:[\w ]*|look for:) ((?:'[^']+'(?:, | or )?)+)")


def example_phrases() -> set[str]:
    """Return what the pages' commands ask a scene.ply, the grammar's table and programs' examples."""
    found: list[str] = []
    for page in PAGES:
        text = page.read_text()
        for program, *words in commands(text):
            named = {"scene.ply", "assets/demo/scene.ply", "scans/"} & {*words}
            if named and not {"--why", "--at"} & {*words}:
                parsed = vars(PARSERS[program](words))
                asked = ("texts", "query", "phrase", "goal", "words")
                found += (p for name in asked for p in np.atleast_1d(parsed.get(name, ())).tolist() if p)
    for row in ROWS.findall((ROOT / "docs" / "searching.md").read_text().replace(" (3)", "")):
        found += re.sub(r" \(.*?\)|, up to.*|; but not.*", "", row).split("; ")
    sources = [path for room in ("langsplat_core", "app") for path in (ROOT / room).rglob("*.py")]
    for said in SAID.findall("\n".join(path.read_text() for path in sources)):
        found += re.findall("'([^']+)'", said)
    return {p for p in found if not re.search(r"/|\bNora|^grandma", p)}


def test_every_example_is_found_in_the_bundled_scene(capsys: pytest.CaptureFixture[str]) -> None:
    phrases = sorted(example_phrases())
    assert {"blue gift", "lid of the teapot", "duck on the table", "toy, not teddy bear"} <= {*phrases}
    assert main("langsplat", lambda: parse(["query", str(DEMO), *phrases, "--json", "-q"])) == 0
    answers = json.loads(capsys.readouterr().out)
    assert len(answers) == len(phrases)
    assert [a["phrase"] for a in answers if not a["found"]] == []


@pytest.mark.long
def test_readme_query_and_headless_viewer_run(tmp_path, monkeypatch, capsys) -> None:
    for path in DEMO.parent.glob("scene.*"):
        shutil.copy(path, tmp_path / path.name)
    monkeypatch.chdir(tmp_path)
    said = {}
    for program, *words in commands(README.read_text()):
        if "--headless" in words or (program, words[0], len(words) > 1) == ("langsplat", "query", True):
            assert main(program, lambda: PARSERS[program](words)) == 0  # noqa: B023  called at once
            said[program] = capsys.readouterr().out
    (answer,) = json.loads(said["langsplat"])
    assert (answer["phrase"], len(answer["pixel"])) == ("lid of the teapot", 2)
    assert np.asarray(Image.open(tmp_path / "heat.png")).std() > 15


BLOCKS = [
    pytest.param(block, id=named(page))
    for page in PAGES
    if page.is_file()
    for block in PYTHON.findall(page.read_text())
]


@pytest.mark.long
@pytest.mark.parametrize("block", BLOCKS)
def test_python_blocks_run(block: str, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(block, "README.md", "exec"), {})
    shapes, answer = capsys.readouterr().out.splitlines()
    assert shapes == "(240, 320, 3) (240, 320)"
    assert answer.startswith("True [")


@pytest.mark.long
def test_notebook_says_and_shows_what_it_keeps() -> None:
    """Up to numbers, and images by their kinds; where it does not, `make notebook` keeps it anew."""
    shell = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell.instance()
    path = ROOT / "docs" / "examples" / "06_in_a_notebook.ipynb"
    assert path.stat().st_size < 1.5e6
    try:
        for cell in json.loads(path.read_text())["cells"]:
            with redirect_stdout(StringIO()) as said:
                done = shell.run_cell("".join(cell["source"]) if cell["cell_type"] == "code" else "")
            done.raise_error()
            shown = {*shell.display_formatter.format(done.result)[0]} if done.result is not None else set()
            words, outputs = said.getvalue().split("Out[")[0], cell.get("outputs", ())
            kept = "".join(line for output in outputs for line in output.get("text", ()))
            assert re.sub(r"\d+", "", words) == re.sub(r"\d+", "", kept)
            assert shown == {kind for output in outputs for kind in output.get("data", ())}
        pages = [shell.display_formatter.format(shell.user_ns[name])[0] for name in ("toys", "answer")]
    finally:
        type(shell).clear_instance()
    for page in pages:
        assert page["text/html"].startswith("<iframe")
        assert len(page["text/html"]) < 3.5e6
        assert len(page["text/plain"]) < 200


# Examples: what each prints, and the files that it draws.

EXAMPLES = {
    "01_render_a_picture": (r"(9\d|100)% covered", "photograph.png", "own_place.png"),
    "02_ask_a_phrase": (r"^blue gift: found, score 0\.[\s\S]*^yellow banana: not here", "relevancy.png"),
    "03_lift_your_own_features": (r"\b(9\d|100)%", "lifted.png"),
    "04_write_a_backend": (r"discs: mean error \S+e-0[12],[\s\S]*cpu: mean error \S+e-0[7-9]",),
}


@pytest.mark.long
@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_say_and_draw_what_they_promise(name: str, tmp_path: Path) -> None:
    path, (said, *images) = str(ROOT / "docs" / "examples" / f"{name}.py"), EXAMPLES[name]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as printed:
        patch.setattr("sys.argv", [path, str(tmp_path)])
        runpy.run_path(path, run_name="__main__")
    assert re.search(said, printed.getvalue(), re.MULTILINE)
    assert all(np.asarray(Image.open(tmp_path / image)).std() > 15 for image in images)
