"""Where the time goes, and how right the picture is."""

import math

import numpy as np
import pytest

from langsplat_viewer.actions import queries, selecting, settings, viewpoint
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.drawing.channels import Clip, Splats
from langsplat_viewer.drawing.frame import FrameRenderer
from langsplat_viewer.panels.layout import in_numbers
from langsplat_viewer.staging import LONGEST_SIDE, reference_of, small
from langsplat_viewer.state import KEPT, Timing, compared, memory_bytes
from tests.support.windowless import errors, rest, settle


def test_the_median_of_the_last_measurements_is_told():
    timing = Timing()
    for value in (1000.0, *range(KEPT)):
        timing.add("sort", value)
    timing.add("blend", 2.0)
    assert timing.medians() == [("Sort", (KEPT - 1) / 2), ("Blend", 2.0)]


def test_errors_are_those_of_the_pictures():
    shown = np.zeros((2, 5, 3), np.uint8)
    reference = shown.copy()
    assert compared(shown, reference, "cpu").psnr == math.inf
    assert "every pixel is the same" in in_numbers(compared(shown, reference, "cpu"))
    reference[0, 0] = (255, 0, 0)
    found = compared(shown, reference, "cpu")
    assert (found.size, found.largest, found.mean) == ((5, 2), 255, 255 / 30)
    assert found.psnr == pytest.approx(10 * math.log10(30))
    assert "5 x 2: error at most 255 of 255, mean 8.5, PSNR 14.8 dB" in in_numbers(found)


def test_memory_is_that_of_this_process():
    before = memory_bytes()
    held = np.ones(200_000_000, np.uint8)
    after = memory_bytes()
    assert before is None or after - before > 0.9 * held.nbytes


@pytest.fixture(params=["cpu", "opengl"])
def drawn(gl, opened, request):
    """A viewer with a real picture."""
    renderer = FrameRenderer(gl, request.param, "single")
    opened.surface = canvas = Canvas(gl, renderer)
    opened.state.backend = renderer.backend
    settings.resize(opened, 400, 300)
    rest(canvas, opened.state, 0.0)
    yield opened
    renderer.release()


def test_the_steps_of_a_picture_are_measured_while_the_panel_is_seen(drawn):
    assert drawn.state.timing.medians() == []
    viewpoint.measure_frame(drawn)
    drawn.state.coarse_while_moving = False
    viewpoint.look_from(drawn, "left")
    viewpoint.tick(drawn, 10.0)
    rest(drawn.surface, drawn.state, 10.0)
    laps, steps = drawn.state.timing.laps, {"projection", "sort", "blend", "compose"}
    if drawn.state.backend == "cpu":
        steps |= {"upload"}
    assert laps.keys() == steps | {"picture"}
    assert sum(laps[name][0] for name in steps) <= laps["picture"][0]


def test_the_panel_has_a_picture_measured_when_it_opens(drawn):
    """All of its steps, though nothing has changed; once."""
    for now in (10.0, 11.0):
        viewpoint.measure_frame(drawn)
        rest(drawn.surface, drawn.state, now)
        counts = {name: len(measured) for name, measured in drawn.state.timing.laps.items()}
        assert counts.keys() >= {"projection", "sort", "blend", "compose", "picture"}
        assert set(counts.values()) == {1}
    drawn.state.timing.wanted = False  # closed, and opened again
    rest(drawn.surface, drawn.state, 12.0)
    viewpoint.measure_frame(drawn)
    rest(drawn.surface, drawn.state, 13.0)
    assert {len(measured) for measured in drawn.state.timing.laps.values()} == {2}


def test_a_search_is_measured(opened):
    queries.ask(opened, "mug")
    settle(opened)
    assert [title for title, _ in opened.state.timing.medians()] == ["Search"]


def wait(viewer) -> None:
    viewer.worker, viewer.recorder = viewer.recorder, viewer.worker
    settle(viewer)
    viewer.worker, viewer.recorder = viewer.recorder, viewer.worker


@pytest.mark.parametrize("look", ["plain", "heat", "wipe", "levels", "changed"])
def test_what_is_shown_is_that_of_the_reference(drawn, look):
    """Whatever is chosen in the window: queries, split, marks, cuts, splats."""
    if look != "plain":
        queries.ask(drawn, "mug")
        settle(drawn)
    if look == "wipe":
        settings.toggle_wipe(drawn)
    if look == "levels":
        settings.toggle_levels(drawn)
    if look == "changed":
        selecting.select_all(drawn)
        settings.set_splats(drawn, Splats(0.5, 0))
        settings.set_clip(drawn, Clip(1.0, 5.2))
        settings.set_colour_map(drawn, "viridis")
    viewpoint.compare_with_reference(drawn)
    wait(drawn)
    found = drawn.state.timing.comparison
    assert errors(drawn) == []
    assert LONGEST_SIDE - 3 < max(found.size) <= LONGEST_SIDE
    assert found.backend == drawn.state.backend
    assert found.mean < 0.05
    assert found.psnr > 45


def test_what_is_wrong_is_told(drawn, monkeypatch):
    right = reference_of(small(drawn.state))().astype(int)
    capture = drawn.surface.capture
    monkeypatch.setattr(drawn.surface, "capture", lambda state: 255 - capture(state))
    viewpoint.compare_with_reference(drawn)
    wait(drawn)
    found = drawn.state.timing.comparison
    assert found.largest == 255
    assert found.mean == pytest.approx(np.abs(255 - 2 * right).mean(), abs=1)


def test_the_picture_on_screen_is_drawn_again_after_it(drawn):
    viewpoint.compare_with_reference(drawn)
    wait(drawn)
    rest(drawn.surface, drawn.state, 2.0)
    assert drawn.surface.textures[0].size == (400, 300)
    depths = drawn.surface.depths()
    assert depths.shape == (300, 400)


def test_there_is_nothing_to_compare_without_a_scene(viewer):
    viewpoint.compare_with_reference(viewer)
    assert "open a scene first" in errors(viewer)[-1]


def test_a_comparison_is_one_at_a_time_and_can_be_left(drawn):
    viewpoint.compare_with_reference(drawn)
    viewpoint.compare_with_reference(drawn)
    assert "wait for it or cancel it" in errors(drawn)[-1]
    viewpoint.stop_comparing(drawn)
    wait(drawn)
    assert drawn.state.timing.comparison is None
