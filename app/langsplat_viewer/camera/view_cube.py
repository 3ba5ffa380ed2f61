"""The cube that shows which way one looks, and turns the view: plain maths, no window."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.scene import look_at
from langsplat_viewer.camera.controls import OrbitCamera, frame_of

# Name of a face -> its normal in the axes right, up and front.
FACES: dict[str, tuple[int, int, int]] = {
    "right": (1, 0, 0),
    "left": (-1, 0, 0),
    "top": (0, 1, 0),
    "bottom": (0, -1, 0),
    "front": (0, 0, 1),
    "back": (0, 0, -1),
}


@dataclass(frozen=True, eq=False)
class Face:
    """One side of the cube that can be seen."""

    name: str
    corners: Array  # (4, 2) in order around it, x right and y down; the cube has edges of length 2
    centre: Array  # (2,)
    towards: float  # in (0, 1]: how much it faces the eye


def visible_faces(view: OrbitCamera) -> tuple[Face, ...]:
    """The one to three sides that face the eye, without perspective."""
    to_screen = view.rotation @ frame_of(view.up).T
    faces = []
    for name, normal in FACES.items():
        middle = to_screen @ np.array(normal, float)
        if middle[2] < -1e-9:
            first, second = (np.roll(np.abs(normal), shift) for shift in (1, 2))
            signs = ((1, 1), (1, -1), (-1, -1), (-1, 1))
            corners = np.array([normal + a * first + b * second for a, b in signs], float) @ to_screen.T
            faces.append(Face(name, corners[:, :2], middle[:2], -float(middle[2])))
    return tuple(faces)


def face_at(faces: Sequence[Face], point: tuple[float, float]) -> str:
    """The name of the face at a place in the cube's own units; "" beside the cube."""
    for face in faces:
        edges = np.roll(face.corners, -1, 0) - face.corners
        to_point = np.asarray(point) - face.corners
        sides = edges[:, 0] * to_point[:, 1] - edges[:, 1] * to_point[:, 0]
        if (sides >= 0).all() or (sides <= 0).all():
            return face.name
    return ""


def facing(view: OrbitCamera, name: str) -> OrbitCamera:
    """The view that sees the face `name` from straight ahead, around the same target at the same distance.

    The world's up is up; from above and below the axis that is nearest to the picture's up now.
    """
    frame = frame_of(view.up)
    normal = np.array(FACES[name], float) @ frame
    up = view.up
    if name in ("top", "bottom"):
        level = np.concatenate([frame[[0, 2]], -frame[[0, 2]]])
        up = level[int((level @ -view.rotation[1]).argmax())]
    seen = look_at(view.target + view.distance * normal, view.target, up, (1, 1))
    return replace(view, rotation=seen.rotation)


def world_axes(view: OrbitCamera) -> Array:
    """(3, 3) where the world's x, y and z point on screen: right, down and away from the eye."""
    return view.rotation.T.copy()
