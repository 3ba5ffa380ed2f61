"""The scene of three blobs: what is selected, hidden and deleted in it, and a flight around it."""

import numpy as np

from langsplat_viewer.camera.controls import extent_of, from_camera, orbit
from langsplat_viewer.camera.flight import Flight, Keyframe, pose_of
from langsplat_viewer.marks import Marks
from langsplat_viewer.viewer import Viewer
from tests.support.fakes import PER_BLOB, WORDS, blob_scene

STRAYS = 0.06  # of a blob, in a picture: what is nearer to the eye is farther from the middle


def blob(word: str) -> np.ndarray:
    """(360,) bool: the Gaussians of one blob."""
    return np.repeat([word == other for other in WORDS], PER_BLOB)


def marks_of(viewer: Viewer) -> Marks:
    return viewer.state.selection.marks


def names(rows: np.ndarray) -> str:
    """The blobs of which `rows` hold all but strays; "?" beside them where one is there in part."""
    shares = rows.reshape(len(WORDS), PER_BLOB).mean(1)
    whole = [word for word, share in zip(WORDS, shares, strict=True) if share >= 1 - STRAYS]
    partly = ["?"] if ((shares > STRAYS) & (shares < 1 - STRAYS)).any() else []
    return " ".join(whole + partly)


def marked(viewer: Viewer) -> tuple[str, str, str]:
    """Selected, hidden, deleted."""
    marks = marks_of(viewer)
    return names(marks.selected), names(marks.hidden), names(marks.deleted)


def flight(away: float = 0.0) -> Flight:
    """A second around the blobs; `away`: turned by so much, radians, everything is behind the camera."""
    view = from_camera(blob_scene().cameras[0], extent_of(blob_scene()))
    keys = []
    for seconds, yaw in ((0.0, 0.0), (0.5, 0.2), (1.0, 0.5)):
        pose = pose_of(orbit(view, yaw, 0))
        if away:
            turned = pose.rotation * np.array([[-1.0], [1.0], [-1.0]])
            pose = type(pose)(pose.position, turned, pose.fov_degrees)
        keys.append(Keyframe(seconds, pose))
    return Flight(tuple(keys))
