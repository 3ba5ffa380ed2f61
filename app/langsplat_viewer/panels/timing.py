"""Where the time goes, how much memory is held, and how right the picture is."""

from imgui_bundle import imgui

from langsplat_viewer import actions
from langsplat_viewer.panels.browser import in_words
from langsplat_viewer.panels.style import muted, small_wrapped, stoppable, tip
from langsplat_viewer.state import Comparison, memory_bytes
from langsplat_viewer.viewer import Viewer


def draw(viewer: Viewer) -> None:
    """Medians of the last pictures, memory, and a comparison."""
    actions.measure_frame(viewer)
    rows = [(title, f"{milliseconds:.1f} ms") for title, milliseconds in viewer.state.timing.medians()]
    memory = memory_bytes()
    if memory is not None:
        rows.append(("Memory", in_words(memory)))
    if imgui.begin_table("timing", 2):
        imgui.table_setup_column("step", imgui.TableColumnFlags_.width_stretch, 5)
        imgui.table_setup_column("time", imgui.TableColumnFlags_.width_stretch, 4)
        for title, text in rows:
            imgui.table_next_row()
            imgui.table_next_column()
            imgui.text(title)
            imgui.table_next_column()
            imgui.text_colored(muted(), text)
        imgui.end_table()
    work = viewer.recorder.current
    if work is not None:
        if stoppable(*work, tag="comparison"):
            actions.stop_comparing(viewer)
    else:
        imgui.begin_disabled(viewer.state.scene is None)
        if imgui.button("Compare with the reference"):
            actions.compare_with_reference(viewer)
        imgui.end_disabled()
        tip("Draws this view small in float64, in the background: about 15 s for 100,000 Gaussians")
    if viewer.state.timing.comparison is not None:
        small_wrapped(in_numbers(viewer.state.timing.comparison), muted())


def in_numbers(comparison: Comparison) -> str:
    """One line."""
    width, height = comparison.size
    what = f"{comparison.backend} against the reference, {width} x {height}"
    if comparison.largest == 0:
        return f"{what}: every pixel is the same"
    errors = f"error at most {comparison.largest} of 255, mean {comparison.mean:.3g}"
    return f"{what}: {errors}, PSNR {comparison.psnr:.1f} dB"
