"""Camera paths around the blobs."""

import numpy as np

from langsplat_viewer.camera.controls import extent_of, from_camera, orbit
from langsplat_viewer.camera.flight import Flight, Keyframe, pose_of
from tests.support.fakes import blob_scene


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
