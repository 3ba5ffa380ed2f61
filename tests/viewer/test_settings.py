"""What is shown and how; messages; the worker."""

import threading

from numpy.testing import assert_allclose

from langsplat_core.errors import InputError
from langsplat_viewer.actions import queries, settings
from langsplat_viewer.panels.style import elided
from langsplat_viewer.state import MAX_MESSAGES
from tests.support.windowless import settle


def test_layers_change_only_when_the_picture_needs_others(opened):
    state = opened.state
    key = state.layers_key()
    settings.set_display(opened, "depth")
    assert state.layers_key() == key
    assert state.latent_rgb() is None
    settings.set_display(opened, "latent", 2)
    assert state.layers_key() != key
    assert_allclose(state.latent_rgb(), state.latent[2])
    settings.set_display(opened, "latent", 1)
    assert_allclose(state.latent_rgb(), state.latent[1])


def test_parts_of_the_window_come_and_go(viewer):
    state = viewer.state
    settings.toggle_panel(viewer)
    settings.toggle_help(viewer)
    assert (state.show_panel, state.show_help) == (False, True)
    settings.toggle_panel(viewer)
    settings.toggle_help(viewer)
    assert (state.show_panel, state.show_help) == (True, False)
    settings.resize(viewer, 0, 300)
    assert state.size == (1, 300)


def test_messages_do_not_grow_without_end(viewer):
    for number in range(3 * MAX_MESSAGES):
        viewer.state.say(f"message {number}")
    viewer.state.say(f"message {3 * MAX_MESSAGES - 1}")  # repeated: once is enough
    assert len(viewer.state.messages) == MAX_MESSAGES
    assert viewer.state.messages[-1].text == f"message {3 * MAX_MESSAGES - 1}"
    assert viewer.state.messages[-2].text != viewer.state.messages[-1].text


def test_worker_delivers_in_order_and_names_user_errors_plainly(viewer):
    seen = []

    def fail(progress):
        raise InputError("two\n lines")

    viewer.worker.submit("a", lambda progress: 1, seen.append, seen.append)
    viewer.worker.submit("b", fail, seen.append, seen.append)
    viewer.worker.submit("c", lambda progress: progress("half", 0.5) or 3, seen.append, seen.append)
    settle(viewer)
    assert seen == [1, "two lines", 3]


def test_the_worker_wakes_the_window_when_there_is_news(viewer):
    woken = []
    viewer.worker.wake = lambda: woken.append(viewer.worker.is_running)
    viewer.worker.submit("a", lambda progress: progress("half", 0.5), lambda nothing: None, print)
    settle(viewer)
    assert len(woken) == 2  # the report, and the end
    assert viewer.worker.delivered == 1
    assert not viewer.worker.is_running


def test_a_job_that_hangs_does_not_keep_the_process(viewer):
    begun, release = threading.Event(), threading.Event()

    def hang(progress):
        begun.set()
        release.wait(10)

    viewer.worker.submit("slow", hang, print, print)
    assert begun.wait(10)
    viewer.worker.close()
    assert viewer.worker.is_running
    assert [t.daemon for t in threading.enumerate() if t.name == "langsplat-worker"] != [False]
    release.set()


def test_letters_meant_for_a_box_that_is_not_there_are_no_keys(viewer):
    queries.focus_search(viewer)
    assert viewer.state.letters_muted
    assert "open a scene" in viewer.state.messages[-1].text
    settings.escape(viewer)
    assert not viewer.state.letters_muted


def test_long_lines_are_cut_where_they_fit():
    assert elided("red mug", 7, len) == "red mug"
    assert elided("a red mug on the table", 10, len) == "a red m..."
    assert elided("two\nlines", 20, len) == "two lines"
    assert elided("anything", 1, len) == "..."
