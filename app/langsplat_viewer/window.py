"""The window. Only this module and the panels use hello_imgui and glfw; the rest is in actions."""

import math
import os
import signal
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from imgui_bundle import hello_imgui, imgui, immapp  # isort: skip
from imgui_bundle.glfw_utils import glfw_window_hello_imgui  # isort: skip  (before glfw, else there are two)
import glfw  # isort: skip
import moderngl
import platformdirs

from langsplat_core.errors import BackendError, InputError, LangSplatError
from langsplat_core.io.files import atomic_path
from langsplat_viewer import projects
from langsplat_viewer.actions import opening, queries, saving, settings, viewpoint
from langsplat_viewer.camera.controls import spanning
from langsplat_viewer.canvas import MOVING_BUDGET, Canvas
from langsplat_viewer.jobs import give_memory_back, on_signals, one_line, share_one_heap
from langsplat_viewer.options import ViewerOptions, chosen_camera, latent_level
from langsplat_viewer.panels import dialogs, layout, menus, navigation, outline, overlays, theme, ui
from langsplat_viewer.panels.navigation import Keyboard
from langsplat_viewer.rendering.renderer import Backend, Renderer, renderer_for
from langsplat_viewer.session import SCALES, Preferences
from langsplat_viewer.viewer import Services, Viewer

# 4.3 sorts splats, 4.1 draws them on every system; 3.3 still shows the CPU's images.
GL_VERSIONS = ((4, 3), (4, 1), (3, 3))


def probe_gl() -> tuple[int, int]:
    """Return the newest of `GL_VERSIONS` that a window can have here.

    Raises BackendError without a display.
    """
    hint = "to draw a picture without a window add --headless --out picture.png"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", glfw.GLFWError)
        is_linux = sys.platform.startswith("linux")
        if is_linux and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise BackendError(f"no display to open a window on (DISPLAY is not set); {hint}")
        if not glfw.init():
            raise BackendError(f"the display cannot be reached; {hint}")
        for major, minor in GL_VERSIONS:
            glfw.window_hint(glfw.VISIBLE, False)
            glfw.window_hint(glfw.CONTEXT_VERSION_MAJOR, major)
            glfw.window_hint(glfw.CONTEXT_VERSION_MINOR, minor)
            glfw.window_hint(glfw.OPENGL_PROFILE, glfw.OPENGL_CORE_PROFILE)
            glfw.window_hint(glfw.OPENGL_FORWARD_COMPAT, True)
            window = glfw.create_window(16, 16, "probe", None, None)
            glfw.default_window_hints()
            if window:
                glfw.destroy_window(window)
                return major, minor
    raise BackendError(f"the display offers no OpenGL 3.3; update the graphics driver, or {hint}")


def _fitting_scale(window_height: float) -> float:
    """Return the text size for the first screen and the window, by their heights in window units."""
    monitor = glfw.get_primary_monitor()
    mode = glfw.get_video_mode(monitor) if monitor else None
    height = mode.size.height / max(glfw.get_monitor_content_scale(monitor)[1], 1.0) if mode else 0.0
    return min(max(round(4 * min(height / 1080, window_height / 600)) / 4, 1.0), SCALES[1])


# Preferences and the layout of the panels outlive the window.


class Workspace:
    """Keeps a folder and the window's appearance in step with the preferences of a `ViewerState`."""

    def __init__(self, folder: Path | None, viewer: Viewer) -> None:
        """`folder` None: nothing is read and nothing written."""
        self._folder = folder
        self._viewer, self._state = viewer, viewer.state
        self._kept: Preferences | None = None  # as they lie on disk; None: they are not kept there
        self._styled: Preferences | None = None  # as the window looks

    def load(self, params: hello_imgui.RunnerParams, size: tuple[int, int] | None) -> None:
        """Take the preferences that are there; where the folder makes no sense say so, and keep nothing."""
        params.ini_disable = True
        params.app_window_params.restore_previous_geometry = False
        scale = _fitting_scale(size[1] if size else math.inf)
        self._state.preferences = replace(self._state.preferences, ui_scale=scale)
        if self._folder is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._state.preferences = projects.load_preferences(self._folder, self._state.preferences)
        except (OSError, InputError) as error:
            self._state.say(f"settings are not remembered: {one_line(error)}", is_error=True)
            return
        self._state.show_help = not (self._folder / projects.FILE_NAME).exists()  # at the first start
        self._kept = self._state.preferences
        settings.take_preferences(self._viewer)
        params.ini_disable = False
        params.ini_folder_type = hello_imgui.IniFolderType.absolute_path
        params.ini_filename = str(self._folder / projects.LAYOUT_NAME)
        params.app_window_params.restore_previous_geometry = size is None

    def style(self) -> None:
        """Make the window look as the preferences say."""
        self._styled = self._state.preferences
        theme.apply(self._styled)

    def update(self) -> None:
        """Apply and keep the preferences that have changed; once per frame."""
        settings.keep_preferences(self._viewer)
        preferences = self._state.preferences
        if self._styled is not None and preferences != self._styled:
            self.style()
        if self._folder is None or self._kept is None or preferences == self._kept:
            return
        before, self._kept = self._kept, preferences
        try:
            projects.save_preferences(self._folder, preferences, before)
        except OSError as error:
            self._state.say(f"settings not written: {one_line(error)}", is_error=True)


TITLE = "LangSplat viewer"
DEFAULT_SIZE = (1280, 800)
IDLE_FPS = 0.01  # frames per second while nothing happens: an event, or the worker, wakes the window at once
AWAKE_SECONDS = 0.4  # after an event: tooltips come, and widgets take their places in a few frames
AWAKE_FRAMES = 4  # after an event, and after news from the worker, for the same reason

RECORDER_PATIENCE = 5.0  # seconds for a film that is being drawn to leave nothing half written


def open_window(path: Path | None, options: ViewerOptions, services: Services) -> None:
    """Run until the window is closed. Raises BackendError where there is no display or no OpenGL."""
    share_one_heap()
    kept = platformdirs.user_config_path("langsplat-viewer", appauthor=False)
    window = Window(path, options, services, folder=None if options.fresh else kept)
    with on_signals(glfw.post_empty_event) as window.signals:
        immapp.run(window.params())
    if window.failure is not None:
        raise window.failure
    if window.is_running:  # they stop for nothing, and libraries wait for them
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)


class Window:
    """Callbacks of one window."""

    def __init__(
        self,
        path: Path | None,
        options: ViewerOptions,
        services: Services,
        make_renderer: Callable[[moderngl.Context, Backend], Renderer[Any]] = renderer_for,
        folder: Path | None = None,
        budget: float = MOVING_BUDGET,
    ) -> None:
        """Keep what is remembered in `folder`, nothing for None; `budget` is that of `Canvas`.

        `path`: what is opened; None: the start page.
        """
        self.viewer = Viewer(services, folder=folder)
        self.failure: LangSplatError | None = None  # why the window could not work
        self._path, self._options, self._size = path, options, options.wanted_size
        self._make_renderer, self._budget = make_renderer, budget
        self.keyboard = Keyboard(self.viewer.state)
        self._docks = layout.Docks()
        self._workspace = Workspace(folder, self.viewer)
        self._canvas: Canvas | None = None
        self._menu = outline.ThingsMenu()
        self._evidence = ui.Picture()
        self._screen: moderngl.Framebuffer | None = None
        self._second: Canvas | None = None  # of the scene beside it
        self.unfinished = False  # a finer image is due
        self.signals: list[int] = []  # that the process got
        self._obeyed = 0  # of them
        self.idles = True  # False for scripts that drive the window and count on its next frame
        self._frames = AWAKE_FRAMES  # to be drawn whatever happens
        self._last: tuple[object, ...] = ()  # what was there in the last frame
        self._tidied: tuple[int, int] = (0, 0)  # news after which memory was given back
        self._titled: tuple[Path | None, str] = None, ""  # the scene that the window's title names, its mark
        self._start_page, self.toasts = dialogs.StartPage(folder), dialogs.Toasts()
        self.files = dialogs.FileDialogs(glfw.post_empty_event)

    def params(self) -> hello_imgui.RunnerParams:
        """Return hello_imgui's parameters. Raises BackendError where no window can be opened."""
        major, minor = probe_gl()
        params = hello_imgui.RunnerParams()
        window = params.app_window_params
        window.window_title = TITLE
        self._workspace.load(params, self._size)
        scale = self.viewer.state.preferences.ui_scale
        width, height = DEFAULT_SIZE
        window.window_geometry.size = self._size or (round(scale * width), round(scale * height))
        if self._size is not None:
            window.window_geometry.window_size_measure_mode = hello_imgui.WindowSizeMeasureMode.screen_coords
        panels = params.imgui_window_params
        panels.default_imgui_window_type = hello_imgui.DefaultImGuiWindowType.provide_full_screen_dock_space
        panels.show_menu_bar, panels.show_menu_app, panels.show_menu_view = True, False, False
        panels.remember_theme = False  # it is one of the preferences
        params.docking_params = layout.params(self.viewer, window.window_geometry.size[0])
        gl = params.renderer_backend_options.open_gl_options
        gl.major_version, gl.minor_version = major, minor
        gl.glsl_version = "410" if (major, minor) >= (4, 1) else "330"
        gl.use_core_profile = gl.use_forward_compat = True
        gl.anti_aliasing_samples = 0  # splats gain nothing from it
        for bits in (glfw.DEPTH_BITS, glfw.STENCIL_BITS):  # nor from these, which take as much as the image
            glfw.window_hint(bits, 0)
        params.fps_idling.fps_idle = IDLE_FPS
        params.fps_idling.time_active_after_last_event = AWAKE_SECONDS
        params.callbacks.default_icon_font = hello_imgui.DefaultIconFont.font_awesome6
        params.callbacks.load_additional_fonts = ui.load_fonts
        params.callbacks.setup_imgui_style = self._workspace.style
        params.callbacks.show_menus = lambda: menus.draw_menus(self.viewer, layout.draw_titles)
        params.callbacks.post_init = self._start
        params.callbacks.pre_new_frame = self.keyboard.feed
        params.callbacks.show_gui = self._gui
        params.callbacks.before_imgui_render = self._draw
        params.callbacks.confirm_exit = self._may_close
        params.callbacks.before_exit = self._stop
        return params

    def _start(self) -> None:
        """Set up what needs the GL context, which is there now, and open the scene."""
        try:
            ctx = moderngl.get_context()
            self._canvas = self._new_canvas(ctx)
            self.viewer.state.backend = self._canvas.backend
        except Exception as error:  # noqa: BLE001  a driver may fail in any way
            self.failure = BackendError(one_line(error))
            return
        self._screen = ctx.detect_framebuffer()
        self.viewer.surface = self._canvas
        self.viewer.worker.wake = self.viewer.recorder.wake = self.viewer.watch.wake = glfw.post_empty_event
        self.viewer.watch.start()
        io = imgui.get_io()
        io.config_input_text_cursor_blink = False  # a blinking cursor would be drawn for ever
        io.config_debug_highlight_id_conflicts = False  # tests look for them
        io.config_drag_click_to_input_text = True  # numbers are dragged, or clicked and typed
        io.config_flags |= imgui.ConfigFlags_.nav_enable_keyboard
        glfw.set_drop_callback(glfw_window_hello_imgui(), lambda _, paths: self.drop(paths))  # type: ignore[arg-type,misc]
        settings.open_panel(self.viewer, "Search")  # before what was left over it the last time
        if self._path is None:
            settings.put(self.viewer.state, show_start=True, show_help=False)
        elif self._path.name.endswith(projects.PROJECTS):  # which says itself how it is looked at
            opening.open_project(self.viewer, self._path, self._ask)
        else:
            opening.open_scene(self.viewer, self._path, self._first_view)

    def _new_canvas(self, ctx: moderngl.Context) -> Canvas:
        canvas = Canvas(ctx, self._make_renderer(ctx, self._options.backend), budget=self._budget)
        canvas.wake_with(glfw.post_empty_event)
        return canvas

    def _draw_beside(self) -> tuple[moderngl.Texture, ...]:
        other = self.viewer.beside
        if other is None:
            if self._second is not None:
                self._second.close()
                self._second.release()
                self._second = None
            return ()
        if self._second is None:
            self._second = self._new_canvas(moderngl.get_context())
        other.surface = self._second
        self.unfinished |= self._second.update(other.state, imgui.get_time())
        return self._second.textures[:1]

    def _ask(self, viewer: Viewer) -> None:
        queries.ask(viewer, "; ".join(self._options.query))

    def _first_view(self, viewer: Viewer) -> None:
        """Apply what else the command line sets, such as camera and queries, once its scene is open."""
        state, options = viewer.state, self._options
        assert state.open is not None
        try:
            if (camera := chosen_camera(options.camera, state.open.scene)) is not None:
                viewpoint.open_at(viewer, camera)
        except InputError as error:
            viewer.say_error(str(error))
        if (span := options.orthographic) is not None:
            viewpoint.move(viewer, lambda view: spanning(view, span))
        wanted = options.picture
        picture = replace(state.session.picture, heat=wanted.heat, heat_scale=wanted.heat_scale)
        settings.set_picture(viewer, picture)
        if options.path is not None:
            viewpoint.load_path(viewer, options.path)
        queries.set_level(viewer, options.level)
        self._ask(viewer)
        if options.beside is not None:
            opening.open_beside(viewer, options.beside)
        show = partial(settings.set_display, viewer, wanted.display, latent_level(options.level))
        show()
        if options.display != "auto":  # a first answer would be shown as heat
            viewer.run("showing", lambda progress: None, lambda nothing: show())

    def drop(self, paths: list[str]) -> None:
        opening.open_dropped(self.viewer, [Path(path) for path in paths])
        self._last = ()  # imgui hears of no event, and what is opened takes some frames

    def _gui(self) -> None:
        viewer = self.viewer
        self.keyboard.keep()
        if self.failure is not None:  # leaving before a first frame would trip an assertion of hello_imgui
            hello_imgui.get_runner_params().app_shall_exit = True
            return
        if len(self.signals) > self._obeyed:
            self._obey()
        if viewer.state.may_close:
            hello_imgui.get_runner_params().app_shall_exit = True
        viewer.take_results()
        viewpoint.tick(viewer, imgui.get_time())
        opening.follow_beside(viewer)
        opening.watch_training(viewer)
        self._docks.apply(viewer)
        self._title()
        self._workspace.update()

    def _obey(self) -> None:
        """Obey the last signal: Ctrl + C asks what to save, SIGTERM saves it, a second one ends at once."""
        self._obeyed, number = len(self.signals), self.signals[-1]
        if self._obeyed > 1:
            saving.end_at_once(self.viewer)
        elif number == signal.SIGTERM:
            saving.end(self.viewer)
        else:
            saving.quit_viewer(self.viewer)
            if not self.viewer.state.may_close:
                print("asked in the window; Ctrl + C again ends at once", file=sys.stderr)

    def _set_idling(self) -> None:
        """Set how soon the next frame is drawn: at once only while something moves or has just changed."""
        viewer, state = self.viewer, self.viewer.state
        idling = hello_imgui.get_runner_params().fps_idling
        news = (viewer.worker.delivered, viewer.recorder.delivered)
        seen = (state.open, state.nothing, state.hover, state.leaving, state.may_close, state.messages)
        now = (news, seen, self.unfinished, viewer.watch.changed, len(self.toasts.shown))
        heard = len(imgui.get_current_context().input_events_trail) > 0  # in this frame, however slow it is
        self._frames = AWAKE_FRAMES if heard or now != self._last else max(self._frames - 1, 0)
        self._last = now
        awaits = any(canvas.waits for canvas in self._canvases)  # and is woken
        busy = (
            (self.unfinished and not awaits)
            or state.glide is not None
            or state.record.began is not None
            or self.keyboard.is_waiting
            or self._frames > 0
        )
        idling.enable_idling = self.idles and (self.is_minimised() or not busy)
        if idling.enable_idling and not awaits and news != self._tidied:
            give_memory_back()  # a driver may have compiled shaders for what came
            self._tidied = news
        # Frames that show nothing new would take the cores from the thread that is waited for.
        idling.time_active_after_last_event = 0.0 if awaits else AWAKE_SECONDS

    @property
    def _canvases(self) -> list[Canvas]:
        return [canvas for canvas in (self._canvas, self._second) if canvas is not None]

    @property
    def is_running(self) -> bool:
        """True while threads are at work that would keep the process."""
        workers = [self.viewer.worker, self.viewer.recorder]
        workers += [] if self.viewer.beside is None else [self.viewer.beside.worker]
        draws = any(canvas.is_running for canvas in self._canvases)
        return draws or any(worker.is_running for worker in workers)

    def is_minimised(self) -> bool:
        return bool(glfw.get_window_attrib(glfw_window_hello_imgui(), glfw.ICONIFIED))

    def _title(self) -> None:
        path, mark = self.viewer.state.path, "*" * self.viewer.state.is_changed
        if path is not None and (path, mark) != self._titled:
            self._keep_thumbnail((self._titled[0],) if path != self._titled[0] else ())
            glfw.set_window_title(glfw_window_hello_imgui(), f"{mark}{path.name} - {TITLE}")
            self._titled = path, mark

    def _keep_thumbnail(self, paths: tuple[Path | None, ...]) -> None:
        """Keep the image on screen as that of the files in `paths`, for the start page."""
        image = None if self._canvas is None else self._canvas.thumbnail()
        for path in paths:
            kept = None if path is None else projects.thumbnail_of(self.viewer.folder, path)
            if image is None or kept is None or path == projects.BUNDLED:
                continue
            with suppress(OSError):
                kept.parent.mkdir(parents=True, exist_ok=True)
                with atomic_path(kept) as temporary:
                    image.save(temporary, format="JPEG")

    def _draw(self) -> None:
        """Take what the panels left of mouse and keys, bring the image up to date and draw it behind them."""
        if self.failure is not None:
            return
        viewer, area = self.viewer, ui.scene_area()
        layout.draw_over(viewer, self._start_page, self.toasts, self.files)
        self._menu.draw(viewer, area)
        overlays.draw_evidence(viewer, self._evidence)
        navigation.handle(viewer, area)
        scale = imgui.get_io().display_framebuffer_scale
        settings.resize(viewer, round(area.width * scale.x), round(area.height * scale.y))
        canvas, state = self._canvas, viewer.state
        if canvas is None or self._screen is None or self.is_minimised():
            self._set_idling()
            return
        try:
            self.unfinished = canvas.update(state, imgui.get_time())
            textures = (*canvas.textures, *self._draw_beside())
        except Exception as error:  # noqa: BLE001  a frame left half way would take the whole window down
            self.unfinished, textures = False, canvas.textures
            viewer.say_error(one_line(error))
        self._set_idling()
        self._screen.use()
        self._screen.color_mask = True, True, True, True  # a mask left set would colour the panels
        overlays.draw_pictures(viewer, area, textures)
        overlays.draw_lines(viewer, area)

    def _may_close(self) -> bool:
        glfw.post_empty_event()  # where there is a question, it is drawn now
        return saving.may_close(self.viewer)

    def _stop(self) -> None:
        self.files.close()
        saving.finish_writing(self.viewer)
        self._workspace.update()
        self._keep_thumbnail((self.viewer.state.path, self.viewer.state.saved.project))
        self.viewer.watch.close()
        for canvas in self._canvases:
            canvas.close()
        if self.viewer.beside is not None:
            self.viewer.beside.worker.close()
        self.viewer.recorder.close(RECORDER_PATIENCE)
        self.viewer.worker.close()
        if self.viewer.training is not None:
            self.viewer.training.end()
            self.viewer.state.say("training stopped; the same entries in Train continue it")
