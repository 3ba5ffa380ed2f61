"""`langsplat serve --mcp`: what an agent may ask, and the protocol with the SDK's own client."""

import asyncio
import base64
import io
import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.extensions.agents.commands import MOST_SIDE, Door, scene_files
from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import PER_BLOB, named_scene

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
    assert Door(scene_files(folder)).scenes() == ["a.ply", os.path.join("blind", "b.ply")]
    with pytest.raises(InputError, match="no scene with a language field"):
        scene_files(tmp_path)


def test_find_answers_in_metres_and_says_what_is_absent(folder):
    door = Door(scene_files(folder))
    answer = door.find("mug", "a.ply")
    assert (answer["verdict"], answer["unit"]) == ("found", "m")
    np.testing.assert_allclose(answer["place"], 2 * middle(0), atol=0.3)
    assert door.count("mug", "a.ply")["least"] >= 1
    apart = door.distance("mug", "book", "a.ply")
    assert 0 < apart["distance"] < 2 * np.linalg.norm(middle(0) - middle(1))
    without_metres = door.distance("mug", "book", os.path.join("blind", "b.ply"))
    assert apart["distance"] == pytest.approx(2 * without_metres["distance"])
    with pytest.raises(InputError, match=r"is not among these 2: a\.ply"):
        door.find("mug", "../a.ply")
    with pytest.raises(InputError, match="is not among these 2"):
        door.find("mug")  # which of them?


def test_images_are_of_what_was_asked_for(folder):
    door = Door(scene_files(folder))
    assert door.look(camera=1, scene="a.ply").shape[:2] == (SCENE.cameras[1].height, SCENE.cameras[1].width)
    towards = door.look("mug", scene=os.path.join("blind", "b.ply"))
    assert max(towards.shape) <= MOST_SIDE
    assert towards.max() > 0
    with pytest.raises(InputError, match="has cameras 0 to"):
        door.look(camera=99, scene="a.ply")


def test_a_client_asks_over_standard_input_and_output(folder):
    pytest.importorskip("mcp")
    from mcp.client import Client
    from mcp.client.stdio import StdioServerParameters

    words = ["-m", "langsplat_core", "serve", "--mcp", str(folder / "a.ply")]
    server = StdioServerParameters(command=sys.executable, args=words, env=dict(os.environ))
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}

    async def talk() -> tuple[list[str], list[object]]:
        async with Client(server, read_timeout_seconds=120) as client:
            tools = (await client.list_tools()).tools
            assert all(tool.annotations is not None and tool.annotations.read_only_hint for tool in tools)
            asked = [("find", {"phrase": "mug"}), ("look", {"phrase": "mug"}), ("find", {"phrase": "the"})]
            return [tool.name for tool in tools], [await client.call_tool(*one) for one in asked]

    names, (found, seen, refused) = asyncio.run(talk())
    assert set(names) == {"scenes", "find", "count", "distance", "describe", "look"}
    assert json.loads(found.content[0].text)["verdict"] == "found"
    image = Image.open(io.BytesIO(base64.b64decode(seen.content[0].data)))
    assert image.size == (SCENE.cameras[0].width, SCENE.cameras[0].height)
    assert refused.is_error
    assert "names nothing to look for" in refused.content[0].text
    assert before == {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
