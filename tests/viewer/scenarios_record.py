"""Scenarios of `window_driver`: the panel "Record", bookmarks, sides."""

import numpy as np

from imgui_bundle import imgui  # isort: skip
from langsplat_viewer.actions import filming, settings
from langsplat_viewer.files.flights import read_flight


def record_and_play(s) -> None:
    """Keyframes by a key, played in the window, saved as a path and as a film."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    record = s.state.record
    settings.open_panel(s.window.viewer, "Record")
    s.ctx.yield_(4)
    for end in ((656, 300), (700, 320)):
        s.ctx.key_press(imgui.Key.k)
        s.drag((600, 300), end)
        s.settle()
    s.ctx.item_click("//**/Add keyframe")
    s.ctx.yield_(2)
    assert [key.seconds for key in record.keyframes] == [0, 2, 4]
    last = s.state.view
    s.ctx.item_click("//**/Clear")
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.z)
    s.ctx.yield_(2)
    assert len(record.keyframes) == 3

    filming.set_path_seconds(s.window.viewer, 1.0)
    start = s.shot("start")
    s.ctx.item_click("//**/Play##path")
    s.wait(lambda: 0.2 < record.at < 1.0)
    moving = s.state.view
    s.wait(lambda: record.began is None)
    assert record.at == 1.0
    np.testing.assert_allclose(s.state.view.eye, last.eye, atol=1e-6)
    assert np.abs(moving.eye - last.eye).max() > 1e-3
    s.ctx.key_press(imgui.Key.mod_shift | imgui.Key.k)  # from the start again
    s.wait(lambda: 0 < record.at < 0.9)
    s.drag((600, 300), (620, 310))  # the hand is stronger
    s.settle()
    assert record.began is None
    assert np.abs(s.shot("elsewhere") - start)[100:500, 400:].max() > 30

    s.ctx.item_click("//**/Save path")
    s.ctx.yield_(2)
    assert len(read_flight(s.folder / "blobs-001.path.json").keyframes) == 3
    filming.set_film_size(s.window.viewer, 32, 24)
    filming.set_film_fps(s.window.viewer, 4.0)
    filming.type_film(s.window.viewer, "film")
    s.ctx.item_click("//Record/Save film")
    s.wait(lambda: s.window.viewer.recorder.current is None)
    s.ctx.yield_(3)
    assert len(list((s.folder / "film").glob("frame-*.png"))) == 5


def mark_and_return(s) -> None:
    """A bookmark by its key, the sides by theirs, the command on the clipboard."""
    s.wait(lambda: s.state.scene is not None)
    s.settle()
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.b)
    s.ctx.yield_(2)
    start = s.state.view
    s.ctx.key_press(imgui.Key.keypad7)
    s.settle()
    np.testing.assert_allclose(s.state.view.rotation[2], -start.up, atol=1e-6)
    settings.open_panel(s.window.viewer, "Bookmarks")
    s.ctx.yield_(4)
    s.ctx.item_click("//**/view 1##bookmark")
    s.settle()
    np.testing.assert_allclose(s.state.view.rotation, start.rotation, atol=1e-6)
    s.ctx.item_click("//**/##bookmark")
    s.ctx.key_chars_append_enter("by the key of k")
    s.ctx.yield_(2)
    assert [mark.name for mark in s.state.bookmarks] == ["view 1", "by the key of k"]
    assert s.state.record.keyframes == ()
    s.ctx.key_press(imgui.Key.mod_ctrl | imgui.Key.mod_shift | imgui.Key.c)
    s.ctx.yield_(3)
    assert imgui.get_clipboard_text().startswith("langsplat-viewer ")


RECORD_SCENARIOS = {
    "record_and_play": (record_and_play, "blobs.ply", {}),
    "mark_and_return": (mark_and_return, "blobs.ply", {}),
}
