"""`langsplat serve --mcp`: what an agent may ask, and the protocol with the SDK's own client."""

import asyncio
import base64
import io
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core import __version__
from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.extensions.agents.commands import MOST_SIDE, SceneTools, served_scenes
from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import PER_BLOB, named_scene
from tests.support.processes import refusal

SCENE = named_scene()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two scenes that can be searched and one that cannot."""
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "blind").mkdir()
    save_scene(folder / "a.ply", replace(SCENE, metres_per_unit=2.0))
    save_scene(folder / "blind" / "b.ply", replace(SCENE, cameras=()))
    save_scene(folder / "plain.ply", Scene(SCENE.gaussians))
    return folder


def middle(blob: int) -> Array:
    return SCENE.gaussians.means[blob * PER_BLOB : (blob + 1) * PER_BLOB].astype(np.float64).mean(0)


def test_scenes_of_a_folder_are_those_that_can_be_searched(folder, tmp_path):
    assert SceneTools(served_scenes(folder)).scenes() == ["a.ply", os.path.join("blind", "b.ply")]
    with pytest.raises(InputError, match="no scene with a language field"):
        served_scenes(tmp_path)


def test_find_answers_in_metres_and_says_what_is_absent(folder):
    tools = SceneTools(served_scenes(folder))
    answer = tools.find("mug", "a.ply")
    assert (answer["verdict"], answer["unit"]) == ("found", "m")
    np.testing.assert_allclose(answer["place"], 2 * middle(0), atol=0.3)
    assert tools.count("mug", "a.ply")["least"] >= 1
    apart = tools.distance("mug", "book", "a.ply")
    assert 0 < apart["distance"] < 2 * np.linalg.norm(middle(0) - middle(1))
    without_metres = tools.distance("mug", "book", os.path.join("blind", "b.ply"))
    assert apart["distance"] == pytest.approx(2 * without_metres["distance"])
    with pytest.raises(InputError, match=r"is not among these 2: a\.ply"):
        tools.find("mug", "../a.ply")
    with pytest.raises(InputError, match="is not among these 2"):
        tools.find("mug")  # which of them?


def test_images_are_of_what_was_asked_for(folder):
    tools = SceneTools(served_scenes(folder))
    image, said = tools.look(camera=1, scene="a.ply")
    assert image.shape[:2] == (SCENE.cameras[1].height, SCENE.cameras[1].width)
    towards, _ = tools.look("mug", scene=os.path.join("blind", "b.ply"))
    assert max(towards.shape) <= MOST_SIDE
    assert towards.max() > 0
    for number, camera in enumerate(SCENE.cameras):  # the one asked for, also with a phrase
        _, said = tools.look("mug", number, "a.ply")
        (pixel,), _ = camera.project(np.array(tools.find("mug", "a.ply")["place"])[None] / 2)
        at = re.fullmatch(rf"by camera {number} {camera.name}, .*; mug: found, .* m, pixel (\d+) (\d+)", said)
        np.testing.assert_allclose([float(at[1]), float(at[2])], pixel, atol=1)
    with pytest.raises(InputError, match="has cameras 0 to"):
        tools.look(camera=99, scene="a.ply")


def test_a_client_asks_over_standard_input_and_output(folder):
    pytest.importorskip("mcp")
    from mcp.client import Client
    from mcp.client.stdio import StdioServerParameters, stdio_client

    words = ["-m", "langsplat_core", "serve", "--mcp", str(folder / "a.ply")]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(os.environ))
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}

    news: list[float] = []

    async def note(done: float, *_: object) -> None:
        news.append(done)

    async def talk() -> tuple[list[object], list[object]]:
        transport = stdio_client(server, sys.__stderr__)  # by default another test's sys.stderr
        async with Client(transport, read_timeout_seconds=120) as client:
            assert client.server_info.version == __version__
            tools = (await client.list_tools()).tools
            assert all(tool.annotations and tool.annotations.read_only_hint for tool in tools)
            asked = [("find", {"phrase": "mug"}), ("look", {"phrase": "mug"}), ("find", {"phrase": "the"})]
            return tools, [await client.call_tool(*one, progress_callback=note) for one in asked]

    tools, (found, seen, refused) = asyncio.run(talk())
    assert {tool.name for tool in tools} == {"scenes", "find", "count", "distance", "describe", "look"}
    assert json.loads(found.content[0].text)["verdict"] == "found"
    image = Image.open(io.BytesIO(base64.b64decode(seen.content[0].data)))
    assert image.size == (SCENE.cameras[0].width, SCENE.cameras[0].height)
    assert seen.content[1].text.startswith("by camera ")
    assert max(news) > 0
    assert refused.is_error
    assert "names nothing to look for" in refused.content[0].text
    assert before == {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}


# The wire itself, by hand: what clients of other makers may send.

BEGIN = (
    {"id": 0, "method": "initialize", "params": {"protocolVersion": "2024-11-05", "capabilities": {},
     "clientInfo": {"name": "test", "version": "1"}}},
    {"method": "notifications/initialized"},
)  # fmt: skip
MALFORMED = ["not json", "[]", "{}", "[" * 200_000, "9" * 5000, '{"id": 1', "\0", "\u2028x", " " * 2_000_000]


@contextmanager
def serving(folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A server that has begun to talk."""
    pytest.importorskip("mcp")
    words = [sys.executable, "-m", "langsplat_core", "serve", "--mcp", str(folder / "a.ply")]
    pipe = subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, stderr=pipe) as server:
        try:
            send(server, *BEGIN)
            assert "result" in json.loads(server.stdout.readline())
            yield server
        finally:
            server.kill()


def send(server: subprocess.Popen[bytes], *messages: dict[str, object]) -> None:
    for message in messages:
        server.stdin.write(json.dumps({"jsonrpc": "2.0"} | message).encode() + b"\n")
    server.stdin.flush()


def call(number: int, tool: str, **arguments: object) -> dict[str, object]:
    return {"id": number, "method": "tools/call", "params": {"name": tool, "arguments": arguments}}


@pytest.mark.parametrize("name", ["plain.ply", "nowhere.ply", "empty", "test.txt"])
def test_server_refuses_what_is_no_scene(folder, capsys, name):
    pytest.importorskip("mcp")
    (folder / "empty").mkdir(exist_ok=True)
    (folder / "test.txt").touch()
    assert name in refusal(capsys, "serve", "--mcp", folder / name)


@pytest.mark.long
def test_malformed_lines_and_wrong_types_are_answered_in_a_line(folder):
    wrong = [{"phrase": 5}, {"phrase": ["mug"]}, {}, {"phrase": "mug", "scene": 7}, {"phrase": None}]
    given = {"phrase": "mug", "scene": None, "camera": None}  # null is absent
    with serving(folder) as server:
        for line in MALFORMED:
            server.stdin.write(line.encode() + b"\n")
            server.stdin.flush()
            assert json.loads(server.stdout.readline())["error"]["code"] in (-32700, -32600)
        for number, arguments in enumerate(wrong, 1):
            send(server, call(number, "find", **arguments))
            result = json.loads(server.stdout.readline())["result"]
            assert result["isError"]
            assert re.fullmatch(r"(phrase|scene): [A-Z][ a-z]+", result["content"][0]["text"])
        send(server, call(9, "look", **given))
        assert not json.loads(server.stdout.readline())["result"]["isError"]
        server.stdin.close()
        assert server.wait(60) == 0
        assert server.stderr.read() == b""


@pytest.mark.long
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_signal_ends_the_server_in_a_line(folder, number, code):
    with serving(folder) as server:
        server.send_signal(number)
        assert server.wait(60) == code
        assert server.stderr.read().count(b"\n") == 1


@pytest.mark.long
def test_a_closed_output_ends_the_server_without_a_word(folder):
    with serving(folder) as server:
        server.stdout.close()
        send(server, call(1, "scenes"))
        assert server.wait(60) == 0
        assert server.stderr.read() == b""


@pytest.mark.slow
def test_two_thousand_calls_are_all_answered(folder, request):
    rng = np.random.default_rng(request.config.getoption("--seed") or 0)
    texts = ["mug", "red mug", "the", "", "book on the table", "mug of mug", "\ud800", "x" * 3000, "not"]
    numbers = [0, 1, -1, 10**30, 1.5, "2", None, True, float("nan"), float("inf")]
    tools = [("find", "phrase"), ("count", "phrase"), ("look", "phrase"), ("distance", "first")]
    memory = []
    with serving(folder) as server:
        for number in range(2000):
            tool, name = tools[int(rng.integers(len(tools)))]
            given: dict[str, object] = {name: texts[int(rng.integers(len(texts)))]}
            if tool == "distance":
                given["second"] = texts[int(rng.integers(len(texts)))]
            if rng.random() < 0.3:
                given["camera" if tool == "look" else "scene"] = numbers[int(rng.integers(len(numbers)))]
            send(server, call(number, tool, **given))
            answer = json.loads(server.stdout.readline())
            assert answer["id"] in (number, None)  # None: of a lone surrogate
            memory.append(Path(f"/proc/{server.pid}/statm").read_text().split()[1])
        server.stdin.close()
        assert server.wait(60) == 0
        assert server.stderr.read() == b""
    assert int(memory[-1]) < int(memory[500]) + 30_000_000 // os.sysconf("SC_PAGE_SIZE")
