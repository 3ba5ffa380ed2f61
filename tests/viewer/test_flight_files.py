"""Camera paths to files and back; files that are none."""

import json
import random

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.errors import InputError
from langsplat_viewer.camera.flight import Flight, Keyframe, Pose
from langsplat_viewer.files.flights import MOST, read_flight, write_flight

POSE = {"position": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "fov_degrees": 50}


def entry(**changed):
    return {"seconds": 0, **POSE, **changed}


def file_of(*entries, version=1):
    return {"langsplat_flight": version, "keyframes": list(entries)}


def test_a_path_is_read_as_it_was_written(tmp_path):
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    keys = tuple(
        Keyframe(t, Pose(np.array([t, 0.1, -2e-7]), rotation, 33.3, span))
        for t, span in ((0.0, None), (1 / 3, 4.2), (2.5, None))
    )
    write_flight(tmp_path / "path.json", Flight(keys))
    assert [path.name for path in tmp_path.iterdir()] == ["path.json"]
    for got, wanted in zip(read_flight(tmp_path / "path.json").keyframes, keys, strict=True):
        assert got.seconds == wanted.seconds
        assert got.pose.fov_degrees == wanted.pose.fov_degrees
        assert got.pose.span == wanted.pose.span
        assert_allclose(got.pose.position, wanted.pose.position, rtol=0, atol=0)
        assert_allclose(got.pose.rotation, wanted.pose.rotation, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("top", "reason"),
    [
        ([], "no camera path"),
        ({}, "no camera path"),
        (file_of(entry(), version=2), "version 2"),
        (file_of(entry(), version=True), "version True"),
        (file_of(), "1 to 10000 keyframes"),
        ({"langsplat_flight": 1, "keyframes": 7}, "1 to 10000 keyframes"),
        (file_of(*[entry()] * (MOST + 1)), "1 to 10000 keyframes"),
        (file_of(3), "keyframe 0: expected an object"),
        (file_of({}), "'position' is missing"),
        (file_of(POSE), "'seconds' is missing"),
        (file_of(entry(seconds=-1)), "0 to 36000"),
        (file_of(entry(seconds=1e9)), "0 to 36000"),
        (file_of(entry(seconds="1")), "'seconds' is not a number"),
        (file_of(entry(seconds=True)), "'seconds' is not a number"),
        (file_of(entry(), entry()), "keyframe 1: 'seconds' is not later"),
        (file_of(entry(), entry(seconds=1e-300)), "keyframe 1: 'seconds' is not later"),
        (file_of(entry(position=[0, 0])), "'position' is not 3 numbers"),
        (file_of(entry(position=[0, 0, 1e300])), "from the origin"),
        (file_of(entry(rotation=[[1, 0, 0]] * 3)), "not a rotation"),
        (file_of(entry(fov_degrees=0)), "0.01 to 179"),
        (file_of(entry(fov_degrees=180)), "0.01 to 179"),
        (file_of(entry(fov_degrees=10**400)), "not a number"),
        (file_of(entry(span=0)), "'span' is 0"),
        (file_of(entry(span=1e300)), "'span' is 1e+300"),
        (file_of(entry(span="wide")), "'span' is not a number"),
    ],
)
def test_what_is_no_path_is_one_line(tmp_path, top, reason):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(top))
    with pytest.raises(InputError) as refused:
        read_flight(path)
    assert reason in str(refused.value)
    assert "path.json" in str(refused.value)


def test_damaged_files_are_refused_or_read_never_worse(tmp_path):
    whole = json.dumps(file_of(entry(), entry(seconds=1.5, position=[1, 2, 3]))).encode()
    path, chance = tmp_path / "path.json", random.Random(0)
    pieces = [b"NaN", b"1e999", b"-", b"{", b"]", b"null", b"\xff", b'"', b"99999999999", b""]
    refused = 0
    for _ in range(400):
        start = chance.randrange(len(whole))
        path.write_bytes(whole[:start] + chance.choice(pieces) + whole[start + chance.randrange(6) :])
        try:
            flight = read_flight(path)
        except InputError as error:
            refused += "\n" not in str(error)
            continue
        for pose in flight.poses(np.linspace(0, 2, 5)):
            assert np.isfinite(pose.position).all()
    assert refused > 200
