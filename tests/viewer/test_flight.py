"""Camera paths: through their keyframes, smooth between them, at rest where nothing changes."""

import json
import math
import random
from itertools import pairwise

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation, RotationSpline

from langsplat_core.errors import InputError
from langsplat_viewer.camera import flight
from langsplat_viewer.camera.controls import extent_of, from_camera, orbit
from langsplat_viewer.camera.flight import Flight, Keyframe, Pose, pose_at, tangents
from langsplat_viewer.projects import MOST_KEYFRAMES, read_flight, write_flight
from tests.support.fakes import blob_scene

STEP = 1e-6  # seconds, of numerical velocities


def turned(*rotvec: float) -> np.ndarray:
    return Rotation.from_rotvec(rotvec).as_matrix()


def key(seconds: float, position=(0, 0, 0), rotvec=(0, 0, 0), fov: float = 50.0) -> Keyframe:
    return Keyframe(seconds, Pose(np.array(position, float), turned(*rotvec), fov))


def random_flight(seed: int, count: int) -> Flight:
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.3, 2.0, count))
    return Flight(
        tuple(key(t, rng.normal(size=3), rng.normal(scale=1.0, size=3), rng.uniform(20, 110)) for t in times)
    )


def speeds(flight: Flight, at: float) -> np.ndarray:
    """(2, 7) velocities before and after a time: of the position, the orientation, and the field of view."""
    found = []
    for first, second in ((at - STEP, at), (at, at + STEP)):
        a, b = flight.poses(np.array([first, second]))
        turn = Rotation.from_matrix(b.rotation.T @ a.rotation).as_rotvec()
        change = np.concatenate([b.position - a.position, turn, [b.fov_degrees - a.fov_degrees]])
        found.append(change / STEP)
    return np.array(found)


def assert_same(got: Pose, wanted: Pose) -> None:
    assert_allclose(got.position, wanted.position, atol=1e-12)
    assert_allclose(got.rotation, wanted.rotation, atol=1e-12)
    assert got.fov_degrees == pytest.approx(wanted.fov_degrees, abs=1e-9)


@pytest.mark.parametrize("count", [1, 2, 3, 8])
def test_path_passes_through_its_keyframes(count):
    keys = random_flight(count, count).keyframes
    times = [keys[0].seconds - 5, *[k.seconds for k in keys], keys[-1].seconds + 9]
    found = Flight(keys).poses(np.array(times))
    for got, wanted in zip(found, (keys[0], *keys, keys[-1]), strict=True):
        assert_same(got, wanted.pose)
    for wrong in ((), (key(1), key(1)), (key(2), key(1))):  # times must rise
        with pytest.raises(ValueError, match="keyframe"):
            Flight(wrong)


@pytest.mark.parametrize("seed", range(5))
def test_velocities_are_continuous(seed):
    flight = random_flight(seed, 7)
    for inner in flight.keyframes[1:-1]:
        before, after = speeds(flight, inner.seconds)
        assert_allclose(before, after, atol=5e-3)
        assert np.abs(before[:6]).max() > 0.05  # and it does not stop there


def test_an_even_turn_stays_even_and_agrees_with_scipys_spline():
    axis = np.array([1.0, 2, -1]) / math.sqrt(6)
    times = np.array([0.0, 1, 2.5, 3, 5])
    flight = Flight(tuple(key(t, rotvec=0.7 * t * axis) for t in times))
    spline = RotationSpline(times, Rotation.from_rotvec(0.7 * times[:, None] * axis))
    for t in np.linspace(0, 5, 41):
        assert_allclose(pose_at(flight, t).rotation, spline(t).as_matrix(), atol=1e-9)
        assert_allclose(pose_at(flight, t).rotation, turned(*(0.7 * t * axis)), atol=1e-12)


def test_path_rests_between_equal_keyframes():
    """A plain spline would swing beyond and back."""
    there = ((1, 2, 3), (0, 0.5, 0), 40)
    flight = Flight((key(0), key(1, *there), key(4, *there), key(5, (2, 2, 2), (0.3, 0, 0))))
    wanted = flight.keyframes[1].pose
    for pose in flight.poses(np.linspace(1, 4, 31)):
        assert_same(pose, wanted)
    assert_allclose(*speeds(flight, 4.0), atol=5e-3)
    zooms = Flight((key(0, fov=60), key(1, fov=61), key(1.1, fov=20), key(4, fov=20)))
    found = [pose.fov_degrees for pose in zooms.poses(np.linspace(0, 4, 400))]
    assert 20 - 1e-9 <= min(found) <= max(found) <= 61 + 1e-9


@pytest.mark.parametrize("angle", [math.pi, math.pi - 1e-9, math.pi + 1e-9, 3.0])
def test_half_turns(angle):
    flight = Flight((key(0), key(1, rotvec=(0, angle, 0)), key(2, rotvec=(0, 0, angle)), key(3)))
    poses = flight.poses(np.linspace(0, 3, 301))
    for pose in poses:
        assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    steps = [np.abs(b.rotation - a.rotation).max() for a, b in pairwise(poses)]
    assert max(steps) < 0.15  # no jump
    assert_allclose(*speeds(flight, 1.0), atol=2e-2)


def test_a_far_keyframe_does_not_move_what_is_near():
    keys = random_flight(3, 8).keyframes
    other = (*keys[:-1], key(keys[-1].seconds, (9, 9, 9), (1, 1, 1)))
    early = keys[4].seconds
    for a, b in zip(*(Flight(k).poses(np.linspace(0, early, 50)) for k in (keys, other)), strict=True):
        assert_same(a, b)


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_extreme_paths_stay_finite(scale):
    rng = np.random.default_rng(5)
    keys = tuple(key(t, scale * rng.normal(size=3), (3.1, 0, 0)) for t in (0, 1e-3, 1, 36_000))
    for pose in Flight(keys).poses(np.linspace(0, 36_000, 500)):
        assert np.isfinite(pose.position).all()
        assert np.isfinite(pose.rotation).all()


def test_keyframes_are_added_in_order_and_stretched():
    keys = flight.with_keyframe(flight.with_keyframe((key(2),), key(0.5)), key(2, (1, 1, 1)))
    assert [k.seconds for k in keys] == [0.5, 2]
    assert_allclose(keys[1].pose.position, 1)
    assert [k.seconds for k in flight.stretched(keys, 6)] == [1.5, 6]
    assert flight.stretched((), 3) == ()
    assert [k.seconds for k in flight.stretched((key(0),), 3)] == [0]


def test_a_turntable_goes_once_around_as_a_drag_does():
    extent = extent_of(blob_scene())
    view = from_camera(blob_scene().cameras[0], extent)
    turn = flight.turntable(view, 8.0)
    for t in (0.0, 1.0, 5.5):
        expected = flight.pose_of(orbit(view, 2 * math.pi * t / 8, 0))
        assert_allclose(pose_at(turn, t).position, expected.position, atol=1e-9)
        assert_allclose(pose_at(turn, t).rotation, expected.rotation, atol=1e-9)
    assert_allclose(pose_at(turn, 8.0).position, view.eye, atol=1e-9)


def test_times_of_pictures():
    assert_allclose(flight.frame_times(Flight((key(0), key(1))), 4), [0, 0.25, 0.5, 0.75, 1])
    assert_allclose(flight.frame_times(Flight((key(0),)), 30), [0])
    view = from_camera(blob_scene().cameras[0], extent_of(blob_scene()))
    assert_allclose(
        flight.frame_times(flight.turntable(view, 1), 4), [0, 0.25, 0.5, 0.75]
    )  # the last is the first again
    assert len(flight.frame_times(flight.turntable(view, 0.1), 1)) == 1
    assert (
        len(flight.frame_times(Flight((key(0), key(0.1 * 3))), 10)) == 4
    )  # 0.3 is a little less than 3 tenths


# Camera paths to files and back; files that are none.

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
        assert (got.seconds, got.pose.fov_degrees) == (wanted.seconds, wanted.pose.fov_degrees)
        assert got.pose.span == wanted.pose.span
        assert_array_equal(got.pose.position, wanted.pose.position)
        assert_array_equal(got.pose.rotation, wanted.pose.rotation)


@pytest.mark.parametrize(
    "top",
    [
        [],
        {},
        file_of(entry(), version=2),
        file_of(entry(), version=True),
        file_of(),
        {"langsplat_flight": 1, "keyframes": 7},
        file_of(*[entry()] * (MOST_KEYFRAMES + 1)),
        file_of(3),
        file_of({}),
        file_of(POSE),
        file_of(entry(seconds=-1)),
        file_of(entry(seconds=1e9)),
        file_of(entry(seconds="1")),
        file_of(entry(seconds=True)),
        file_of(entry(), entry()),
        file_of(entry(), entry(seconds=1e-300)),
        file_of(entry(position=[0, 0])),
        file_of(entry(position=[0, 0, 1e300])),
        file_of(entry(rotation=[[1, 0, 0]] * 3)),
        file_of(entry(fov_degrees=0)),
        file_of(entry(fov_degrees=180)),
        file_of(entry(fov_degrees=10**400)),
        file_of(entry(span=0)),
        file_of(entry(span=1e300)),
        file_of(entry(span="wide")),
    ],
)
def test_file_without_a_path_is_refused_in_one_line(tmp_path, top):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(top))
    with pytest.raises(InputError) as refused:
        read_flight(path)
    assert str(refused.value).startswith(f"{path}: no camera path (")
    assert str(refused.value).endswith("; save it anew")
    assert str(refused.value).isprintable()


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


def test_tangents_of_uneven_keyframes_are_those_of_a_parabola():
    times, start, speed, bend = np.array([0.0, 1.0, 3.0, 3.5]), *np.random.default_rng(1).normal(size=(3, 3))
    places = start + times[:, None] * speed + times[:, None] ** 2 * bend
    found = tangents(times, np.diff(places, axis=0), 1e-9)
    assert_allclose(found[1:-1], (speed + 2 * times[:, None] * bend)[1:-1])
