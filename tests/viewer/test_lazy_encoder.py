"""When the viewer loads the text encoder, and what it says if that fails."""

from dataclasses import replace
from pathlib import Path

import pytest

from langsplat_core.errors import EncoderError
from langsplat_viewer.actions import opening, queries, settings
from langsplat_viewer.viewer import Services
from tests.support.fakes import FakeEncoder
from tests.support.windowless import load, settle


def test_an_unexpected_error_of_the_encoder_is_one_line_too(viewer):
    def broken(encoder_id: str):
        raise ZeroDivisionError("deep\ninside")

    viewer.services = replace(viewer.services, load_encoder=broken)
    opening.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    queries.ask(viewer, "mug")
    settle(viewer)
    assert viewer.state.queries[0].problem == "internal error: ZeroDivisionError: deep inside"
    settings.set_display(viewer, "depth")  # and life goes on
    assert viewer.state.picture.display == "depth"


@pytest.mark.parametrize("encoder_id", ["demo", "~", "somebody/some-model"])
def test_a_local_encoder_is_loaded_while_the_user_looks_round(viewer, encoder_id):
    """A hub id may mean a download: it waits for a phrase."""
    asked = []
    viewer.services = Services(load, lambda name: asked.append(name) or FakeEncoder(), encoder_id)
    opening.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    assert asked == ([] if "/" in encoder_id else [encoder_id])
    queries.ask(viewer, "mug")
    assert viewer.worker.current == ("searching 'mug'", 0.0) or asked
    settle(viewer)
    assert asked == [encoder_id]
    assert viewer.state.queries[0].result.found


def test_phrasebook_needs_no_encoder(viewer):
    def absent(encoder_id: str):
        raise EncoderError("no weights; download them")

    viewer.services = replace(viewer.services, load_encoder=absent)
    opening.open_scene(viewer, Path("book.ply"))
    settle(viewer)
    queries.ask(viewer, "Book")
    queries.ask(viewer, "mug")
    settle(viewer)
    book, mug = viewer.state.queries
    assert book.result.found
    assert mug.problem == "no weights; download them"


def test_the_encoder_of_the_command_line_comes_before_the_scenes(viewer):
    asked = []

    def load_encoder(encoder_id: str) -> FakeEncoder:
        asked.append(encoder_id)
        return FakeEncoder()

    viewer.services = Services(load, load_encoder, "mine")
    opening.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    queries.ask(viewer, "mug")
    queries.ask(viewer, "book")
    settle(viewer)
    assert asked == ["mine"]  # once for both
