"""`langsplat serve --mcp`: scenes as tools for agents, by the Model Context Protocol on standard streams."""

import asyncio
import io
import json
import os
from collections.abc import AsyncIterator, Callable
from contextvars import ContextVar
from dataclasses import dataclass
from functools import partial
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from PIL import Image

from langsplat_core import __version__
from langsplat_core.arrays import Array, decimals_of
from langsplat_core.cli.arguments import EncoderOption
from langsplat_core.cli.describe import outline_lines, outline_of
from langsplat_core.cli.query import Unit, camera_of
from langsplat_core.errors import InputError, LangSplatError, optional_imports, printable_line
from langsplat_core.extensions.library.index import scenes_in
from langsplat_core.interrupts import end, handled
from langsplat_core.io.scenes import format_of
from langsplat_core.pipeline.notebook import view_distance
from langsplat_core.progress import Progress, Report, silent
from langsplat_core.query.answers import QueryResult
from langsplat_core.query.compose import count_instances, run_phrase
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine, searchable
from langsplat_core.query.relations import body, gap, separate, upright
from langsplat_core.raster.render import render
from langsplat_core.scene import LEVELS, Camera, Scene
from langsplat_core.scene.scene import look_at
from langsplat_core.semantics.encoders import load_text_encoder

if TYPE_CHECKING:
    from mcp.server import MCPServer

INSTRUCTIONS = (
    "Trained 3D scenes that can be searched with words. A verdict of 'not here' or 'weak match' is meant: do "
    "not report such a thing as there. Nothing is changed by any tool."
)
MOST_SIDE = 1024  # px, longer side of images that are sent
SIZE = (640, 480)  # px of images of a scene without cameras
BACK = 2.2  # distance of such a camera from an answer, in half diagonals of its box

LONGEST_LINE = 1 << 20  # characters of a message
NO_JSON, INVALID = -32700, -32600  # codes of JSON-RPC

PROGRESS = ContextVar("PROGRESS", default=silent)  # of the current call


@dataclass(frozen=True)
class Serve:
    """Serve scenes to an agent: find, count, measure, describe, look. Nothing is changed."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it, or a folder of scenes."""
    mcp: bool = False
    """Speak the Model Context Protocol on standard input and output; started by the agent's program."""
    encoder: EncoderOption = ""

    @optional_imports()
    def run(self) -> None:
        if not self.mcp:
            raise InputError("say how: --mcp is the Model Context Protocol, on standard input and output")
        tools = SceneTools(served_scenes(self.scene), self.encoder)
        if len(tools.scenes()) == 1:  # opened at the start, so that errors are reported here
            tools.engine()
        server = build_server(tools)
        with handled(lambda number, _: end("langsplat", number)):  # nothing has to be saved
            asyncio.run(_serve(server))


def served_scenes(place: Path) -> dict[str, Path]:
    """Return searchable scenes by name; those of a folder by their path in it. InputError for none."""
    if not place.is_dir() or format_of(place) is not None:
        return {place.name: place}
    return scenes_in(place)


class SceneTools:
    """The tools of an agent for some scenes.

    Answers are ready for JSON, lengths in metres if the scene has a scale. Not for concurrent calls; scenes
    and encoders stay in memory once they are loaded.
    """

    def __init__(self, scenes: dict[str, Path], encoder: str = "") -> None:
        self._scenes, self._encoder_id = scenes, encoder
        self._engines: dict[str, QueryEngine] = {}

    def scenes(self) -> list[str]:
        """Return the names of the scenes that can be searched."""
        return list(self._scenes)

    def find(self, phrase: str, scene: str = "") -> dict[str, Any]:
        """Find where something is: a phrase such as 'blue gift', 'lid of the teapot' or 'duck on the table'.

        The verdict is 'found', 'weak match' or 'not here'; place is the centre of the best one, box its
        corners.
        """
        engine = self.engine(scene)
        composed = run_phrase(engine, phrase, viewpoint=_first(engine.scene))
        answer, unit = composed.answer, _unit(engine.scene)
        there = answer.found or answer.verdict == "weak match"
        return {
            "verdict": answer.verdict,
            "probability": answer.probability,
            "by_chance": answer.judgement.by_chance,
            "read_as": composed.reading,
            "level": LEVELS[answer.level],
            "place": _places(answer.place, unit) if there else None,
            "box": _places(answer.box, unit) if there else None,
            "unit": unit.name,
            "answers_stand_on": engine.basis.long,
        }

    def count(self, phrase: str, scene: str = "") -> dict[str, Any]:
        """Count what a phrase names, with the least and most there may be; 0 if it is not found."""
        engine = self.engine(scene)
        answer = run_phrase(engine, phrase, viewpoint=_first(engine.scene)).answer
        number = count_instances(engine, answer) if answer.found else None
        counts = (0, 0, 0) if number is None else (number.best, number.least, number.most)
        return dict(zip(("count", "least", "most"), counts, strict=True)) | {"verdict": answer.verdict}

    def distance(self, first: str, second: str, scene: str = "") -> dict[str, Any]:
        """Measure the distance of the nearest points of two things, each named by a phrase."""
        engine = self.engine(scene)
        frame, unit = upright(engine.scene.up()), _unit(engine.scene)
        bodies = []
        for phrase in (first, second):
            answer = self._found(engine, phrase)
            parts = separate(engine.surface, answer.members[engine.surface.rows], engine.tree)
            bodies.append([body(engine.surface.positions[part], frame) for part in parts])
        if not all(bodies):
            raise InputError("what was found has no surface to measure from; ask for something larger")
        least = min(gap(one, other) for one in bodies[0] for other in bodies[1])
        return {"distance": unit.length * least, "unit": unit.name}

    def describe(self, scene: str = "") -> str:
        """Return what is in a scene: an outline of its things with their parts, sizes and counts."""
        engine = self.engine(scene)
        lines = outline_lines(outline_of(Describer(engine, None, PROGRESS.get())), _unit(engine.scene))
        return "\n".join([*lines, f"answers: {engine.basis.long}"])

    def look(self, phrase: str = "", camera: int | None = None, scene: str = "") -> tuple[Array, str]:
        """Return an (H, W, 3) uint8 image, and text with its camera and the position of a thing in it.

        The camera is that of the number given, else the nearest one that shows what the phrase finds, else
        the first.
        """
        engine = self.engine(scene)
        shown, unit = engine.scene, _unit(engine.scene)
        answer = self._found(engine, phrase) if phrase else None
        if camera is not None:
            view = camera_of(shown, camera)
        elif answer is not None:
            view = towards(shown, answer)
        else:
            view = _first(shown) or shown.framing_camera(SIZE)
        PROGRESS.get()("drawing", 0.0)
        number = [f"camera {row} " for row, one in enumerate(shown.cameras) if one is view]
        view = view.within(MOST_SIDE)
        said = f"by {''.join(number)}{view.name or 'a new camera'}, {view.width} x {view.height} pixels"
        if answer is not None and answer.place is not None:
            pixels, depths = view.project(answer.place[None])
            (x, y), inside = pixels[0], view.in_image(pixels, depths).all()
            at = f"pixel {x:.0f} {y:.0f}" if inside else "outside of this image"
            said += f"; {phrase}: {answer.said}, place {unit.place(answer.place)} {unit.name}, {at}"
        colours = render(shown, view).colours
        return np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8), said

    def engine(self, name: str = "") -> QueryEngine:
        """Return the engine of a scene, which the first call opens; InputError for an unknown name."""
        if not name and len(self._scenes) == 1:
            name = next(iter(self._scenes))
        if name not in self._scenes:
            known = ", ".join(list(self._scenes)[:5]) + (", ..." if len(self._scenes) > 5 else "")
            raise InputError(f"scene {name!r} is not among these {len(self._scenes)}: {known}")
        if name not in self._engines:
            PROGRESS.get()("opening the scene", 0.0, name)
            scene = searchable(self._scenes[name])
            self._engines[name] = QueryEngine(scene, load_text_encoder, encoder_id=self._encoder_id)
        PROGRESS.get()("asking", 0.0)
        return self._engines[name]

    def _found(self, engine: QueryEngine, phrase: str) -> QueryResult:
        answer = run_phrase(engine, phrase, viewpoint=_first(engine.scene)).answer
        if not answer.found:
            raise InputError(f"'{phrase}': {answer.verdict}")
        return answer


def _first(scene: Scene) -> Camera | None:
    return scene.cameras[0] if scene.cameras else None


def _unit(scene: Scene) -> Unit:
    return Unit(scene.metres_per_unit, scene.origin)


def _places(values: Array | None, unit: Unit) -> Any:
    if values is None:
        return None
    decimals = decimals_of(unit.length * values, 4)
    return np.round(unit.length * (unit.origin + values), decimals).tolist()


def towards(scene: Scene, answer: QueryResult) -> Camera:
    """Return the scene's best camera for an answer, see `view_distance`; a new one without cameras."""
    assert answer.place is not None
    assert answer.box is not None
    if scene.cameras:
        return min(scene.cameras, key=partial(view_distance, place=answer.place))
    middle, reach = answer.box.mean(0), BACK * float(np.linalg.norm(np.ptp(answer.box, axis=0))) / 2
    away = scene.framing_camera(SIZE).position - middle
    return look_at(middle + reach * away / max(float(np.linalg.norm(away)), 1e-300), middle, scene.up(), SIZE)


class _LineStreams:
    """Standard input and output with one message per line; other lines are answered with an error.

    A closed output ends the program. Output of libraries is redirected to standard error.
    """

    def __init__(self) -> None:
        self._in = open(os.dup(0), encoding="utf-8", errors="replace")  # noqa: SIM115  as long as the process
        self._out = open(os.dup(1), "w", encoding="utf-8")  # noqa: SIM115
        os.dup2(2, 1)

    async def __aiter__(self) -> AsyncIterator[str]:
        from mcp_types import jsonrpc_message_adapter

        while line := await asyncio.to_thread(self._in.readline, LONGEST_LINE):
            code, said = NO_JSON, "not JSON"
            whole = line.endswith("\n")
            while not whole and (more := await asyncio.to_thread(self._in.readline, LONGEST_LINE)):
                line, whole = "", more.endswith("\n")
            try:
                json.loads(line or "0")
                code, said = INVALID, f"no message of the protocol of at most {LONGEST_LINE} characters"
                jsonrpc_message_adapter.validate_json(line, by_name=False)
                yield line
            except (ValueError, RecursionError):
                answer = {"jsonrpc": "2.0", "id": None, "error": {"code": code, "message": said}}
                await self.write(json.dumps(answer) + "\n")
                await self.flush()

    async def write(self, text: str) -> None:
        self._out.write(text)

    async def flush(self) -> None:
        """Flush the output; if it is closed, end the program without a message, as with `| head`."""
        try:
            await asyncio.to_thread(self._out.flush)
        except BrokenPipeError:
            os._exit(0)
        except OSError as error:
            os.write(2, f"langsplat: standard output cannot be written ({error.strerror})\n".encode())
            os._exit(2)


async def _serve(server: "MCPServer[Any]") -> None:
    from mcp.server.stdio import stdio_server

    wire: Any = _LineStreams()
    core = server._lowlevel_server  # noqa: SLF001  as the SDK's own `run_stdio_async` does
    async with stdio_server(wire, wire) as (incoming, outgoing):
        await core.run(incoming, outgoing, core.create_initialization_options())


def _told(send: Callable[..., Any]) -> Progress:
    """Return the progress of one call, sent as the number of finished stages, which must grow, and text."""
    from anyio.from_thread import run

    stages: dict[str, int] = {}
    sent = [-1.0]

    def show(report: Report) -> None:
        done = stages.setdefault(report.stage, len(stages)) + report.fraction
        if done >= sent[-1] + 0.02:  # not more often
            sent.append(done)
            run(send, done, None, report.text)

    return Progress(show)


def build_server(tools: SceneTools) -> "MCPServer[Any]":
    """Return a server of the protocol with these tools; failures are tool errors of one line."""
    from mcp.server import MCPServer
    from mcp.server.mcpserver import Context
    from mcp.server.mcpserver import Image as Picture
    from mcp.server.mcpserver.exceptions import ToolError
    from mcp_types import ToolAnnotations
    from pydantic import ValidationError

    class Server(MCPServer[Any]):
        turn = asyncio.Lock()  # one call at a time

        async def call_tool(
            self, name: str, arguments: dict[str, Any], context: Context[Any, Any] | None = None
        ) -> Any:
            given = {key: value for key, value in arguments.items() if value is not None}
            if context is not None:
                PROGRESS.set(_told(context.report_progress))
            try:
                async with self.turn:
                    return await super().call_tool(name, given, context)
            except ToolError as error:
                said, cause = str(error), error.__cause__
                if isinstance(cause, ValidationError):  # the SDK's message has several lines
                    wrong = [f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in cause.errors()]
                    said = "; ".join(wrong)
                elif isinstance(cause, LangSplatError | OSError | MemoryError):
                    said = str(cause)
                raise ToolError(printable_line(said, 300)) from None

    server = Server("langsplat", instructions=INSTRUCTIONS, version=__version__, log_level="CRITICAL")

    def look(phrase: str = "", camera: int | None = None, scene: str = "") -> list[Picture | str]:
        encoded, (drawn, said) = io.BytesIO(), tools.look(phrase, camera, scene)
        Image.fromarray(drawn).save(encoded, "PNG")
        return [Picture(data=encoded.getvalue(), format="png"), said]

    look.__doc__ = (SceneTools.look.__doc__ or "").replace("(H, W, 3) uint8 image", "image")
    hints = ToolAnnotations(read_only_hint=True, destructive_hint=False, open_world_hint=False)
    for ask in (tools.scenes, tools.find, tools.count, tools.distance, tools.describe, look):
        server.tool(description=cleandoc(ask.__doc__ or ""), annotations=hints)(ask)
    return server
