"""Viewers without a window."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from langsplat_viewer import actions
from langsplat_viewer.viewer import Services, Viewer
from tests.support.fakes import FakeEncoder
from tests.support.windowless import FakeSurface, load, settle


@pytest.fixture
def viewer() -> Iterator[Viewer]:
    """Nothing is open."""
    made = Viewer(Services(load, lambda encoder_id: FakeEncoder()), surface=FakeSurface())
    yield made
    made.worker.close()


@pytest.fixture
def opened(viewer: Viewer) -> Viewer:
    """Shows the scene of three blobs."""
    actions.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    return viewer
