"""INRIA's cameras.json."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import read_cameras, write_cameras
from tests.support.scenes import random_camera


def entry(**changes):
    """A camera at (1, 2, 3) that is turned by 90 degrees about its down axis: it looks along world +x."""
    plain = {
        "id": 0,
        "img_name": "frame_01",
        "width": 64,
        "height": 48,
        "position": [1.0, 2.0, 3.0],
        "rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
        "fx": 50.0,
        "fy": 55.0,
    }
    return {key: value for key, value in (plain | changes).items() if value is not None}


@pytest.fixture
def put(tmp_path):
    def write(value):
        path = tmp_path / "scene.cameras.json"
        path.write_text(value if isinstance(value, str) else json.dumps(value))
        return path

    return write


def test_what_is_written_is_read_back(tmp_path):
    want = tuple(replace(random_camera(i, width=70 + i), name=f"Tür {i}.a") for i in range(5))
    write_cameras(tmp_path / "a.json", want)
    got = read_cameras(tmp_path / "a.json")
    for a, b in zip(got, want, strict=True):
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy, a.name) == (
            b.width,
            b.height,
            b.fx,
            b.fy,
            b.cx,
            b.cy,
            b.name,
        )
        # the centre of projection is stored instead of the translation: a few rounding errors
        np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-14)


def test_no_cameras(tmp_path):
    write_cameras(tmp_path / "a.json", ())
    assert read_cameras(tmp_path / "a.json") == ()


def test_numpy_numbers_are_written(tmp_path):
    camera = replace(random_camera(), fx=np.float32(50.5), width=np.int64(64))
    write_cameras(tmp_path / "a.json", (camera,))
    assert read_cameras(tmp_path / "a.json")[0].fx == 50.5


def test_the_inria_convention(put):
    camera = read_cameras(put([entry()]))[0]
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    np.testing.assert_allclose(camera.rotation[2], [1, 0, 0])  # forward, in the world
    pixel, depth = camera.project(np.array([[6.0, 2.0, 3.0], [6.0, 3.0, 3.0], [6.0, 2.0, 2.0]]))
    np.testing.assert_allclose(depth, 5)
    # the middle; below it, since y points down; to the right of it, which is world -z
    np.testing.assert_allclose(pixel, [[32, 24], [32, 24 + 55 / 5], [32 + 50 / 5, 24]])
    assert camera.name == "frame_01"


@pytest.mark.parametrize(
    ("stored", "name"),
    [("a.jpg", "a"), ("a.JPEG", "a"), ("frame.01", "frame.01"), ("x/y.png", "x/y"), ("", "")],
)
def test_names_lose_the_suffix_of_an_image(put, stored, name):
    assert read_cameras(put([entry(img_name=stored)]))[0].name == name


def test_principal_point(put):
    camera = read_cameras(put([entry(cx=30, cy=20.5)]))[0]
    assert (camera.cx, camera.cy) == (30, 20.5)


TURNED = entry()["rotation"]
BROKEN = {
    "not a list": ({"a": 1}, "expected a list of cameras"),
    "not objects": ([1], "camera 0: expected an object"),
    "no width": ([entry(), entry(width=None)], "camera 1: 'width' is missing"),
    "width of nought": ([entry(width=0)], "'width' is 0; expected whole pixels"),
    "half a pixel": ([entry(height=47.5)], "'height' is 47.5; expected whole pixels"),
    "a width for gigabytes": ([entry(width=10**9)], "'width' is 1e[+]09; expected whole pixels, 1 to 65536"),
    "a width beyond float": ([entry(width=10**400)], "'width' is not a number"),
    "a width of text": ([entry(width="64")], "'width' is not a number"),
    "a width of truth": ([entry(width=True)], "'width' is not a number"),
    "two numbers for a place": ([entry(position=[1, 2])], "'position' is not 3 numbers"),
    "an infinite place": ("[" + json.dumps(entry()).replace("3.0]", "Infinity]") + "]", "'position' is not"),
    "a place beyond sense": ([entry(position=[0, 2e9, 0])], "more than 1e[+]09 units from the origin"),
    "a rotation that overflows": ([entry(rotation=[[1e200] * 3] * 3)], "'rotation' is not a rotation"),
    "ragged rotation": ([entry(rotation=[[1, 0, 0], [0, 1], [0, 0, 1]])], "'rotation' is not 3 rows"),
    "a scaled rotation": (
        [entry(rotation=[[2 * x for x in row] for row in TURNED])],
        "'rotation' is not a rotation",
    ),
    "a mirror": ([entry(rotation=[[-x for x in row] for row in TURNED])], "'rotation' is not a rotation"),
    "no focal length": ([entry(fx=0)], "fx and fy must be positive"),
    "a name of numbers": ([entry(img_name=7)], "'img_name' is not a text"),
    "half a file": (json.dumps([entry()])[:-9], "not readable as JSON"),
    "nesting": ("[" * 100_000, "not readable as JSON"),
    "digits": ("[" + "9" * 5000 + "]", "not readable as JSON"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(put, case):
    value, message = BROKEN[case]
    path = put(value)
    with pytest.raises(FormatError, match=message) as caught:
        read_cameras(path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text(tmp_path):
    (tmp_path / "a.json").write_bytes(b"[\xff\xfe\x00")
    with pytest.raises(FormatError, match="not readable as JSON"):
        read_cameras(tmp_path / "a.json")


def test_a_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_cameras(tmp_path / "a.json")
