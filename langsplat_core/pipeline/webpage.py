"""A scene as one HTML file that a browser draws and searches without a network: `make_page`.

The file holds a compressed safetensors file (Gaussians of 8 and 16 bits, codes, codebook, words, regions)
and the modules of `langsplat_core/web`, which answer by the rule of `query.rule`; what does not depend on the
phrase is computed here. Gaussians that are never drawn are left out; along a curve the others compress well.
"""

import base64
import hashlib
import html
import json
import re
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from io import BytesIO
from typing import Any, get_args
from urllib.parse import urlencode

import numpy as np
from PIL import Image
from safetensors.numpy import save

from langsplat_core.arrays import Array, sigmoid, unit
from langsplat_core.config import LevelChoice, PictureConfig
from langsplat_core.display import displays
from langsplat_core.display.composing import compose
from langsplat_core.errors import EncoderError, InputError
from langsplat_core.io.quantised import to_bytes
from langsplat_core.progress import Progress, silent
from langsplat_core.query import grammar, relations, taught
from langsplat_core.query.answers import place_of
from langsplat_core.query.compose import HALF
from langsplat_core.query.engine import QueryEngine, TextEncoder, no_field
from langsplat_core.query.instances import BOXED, INNER, oriented_box
from langsplat_core.query.inventory import suggest
from langsplat_core.query.rule import LOW, RULE
from langsplat_core.raster.opengl import WEB, shader, splat_shaders
from langsplat_core.raster.render import render, view_of
from langsplat_core.scene import LEVELS, Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import along_curve
from langsplat_core.semantics.clip_plain import PlainClipText
from langsplat_core.semantics.encoders import PhraseEncoder
from langsplat_core.semantics.relevancy import BUNDLED, bundled_vocabulary

# In an order in which each imports only those before it, so that their code can stand in one script.
MODULES = ("words", "rule", "encoder", "camera", "space", "language", "data", "draw", "headset", "page")
BEGIN = "// [page]\n"  # between imports and code of a module
LISTS = ("ARTICLES", "STOP_WORDS", "ADJECTIVES", "COLOURS", "PARTS", "ALSO_NOUNS", "OWN_SINGULARS",
         "MEASURES", "OWNERS")  # fmt: skip
TABLES = ("PREPOSITIONS", "SUPERLATIVES", "NUMBERS", "PLURALS", "ENDINGS")  # also in query/grammar.py
STILL = 1280  # pixels of the longer side of the picture in the page
WIDE = 10  # columns of 16 bits: means, scales, quaternions
# Numbers of query/relations.py by which a page relates things.
NUMBERS = ("SAMPLE", "FEWEST", "SPECK", "NEAR", "TOUCH", "FOOT", "FLAT", "HELD", "SUNK", "ASIDE")
CHUNK = 256  # Gaussians that share the range of a quantised column
FLATTEST, OPAQUE = -46.0, 20.0  # log scales are clipped to [-46, 46], logits to [-20, 20]


@dataclass(frozen=True)
class PageReport:
    """The content of a page."""

    gaussians: int
    phrases: int  # number that completion offers
    free_text: bool  # the encoder is in the page, so that any of its words may be combined
    bytes: int
    why_not: str = ""  # reason why nothing can be searched, "" where it can


def covered(scene: Scene, cameras: Sequence[Camera]) -> Array:
    """Return (N,) float32: each Gaussian's largest summed weight in any camera's image of 320 px, pixels."""
    most = np.zeros(len(scene.gaussians), np.float32)
    for camera in (each.within(320) for each in cameras):
        np.maximum(most, view_of(scene, camera).contributions(), out=most)
    return most


def make_page(
    scene: Scene,
    engine: QueryEngine | None,
    title: str,
    progress: Progress = silent,
    first: Sequence[Camera] = (),
    notes: Sequence[tuple[str, Sequence[float]]] = (),
    phrase: str = "",
    at_most: int | None = None,
) -> tuple[str, PageReport]:
    """Return the HTML of `scene`, searched by `engine`; InputError where nothing can be drawn.

    first: views ahead of the scene's cameras, the first of which the page opens with. notes: texts and the
    (3,) points that they are pinned to, in the scene's units. phrase: the first query. at_most: number
    of Gaussians that are drawn, those that cover most of a view; answers are those of all.
    """
    gaussians = scene.gaussians
    rows = np.flatnonzero(gaussians.valid() & (sigmoid(gaussians.opacity_logits) >= 1 / 255))
    if len(rows) == 0:
        raise InputError(f"{scene.path}: no Gaussian of this scene can be drawn; there is nothing to export")
    seen_from = views(scene, first)
    if at_most is not None and len(rows) > at_most:
        rows = rows[np.argsort(-covered(scene, seen_from)[rows], kind="stable")[:at_most]]
    rows = rows[np.argsort(along_curve(gaussians.means[rows]), kind="stable")]
    centre, radius = scene.bounds()
    progress("packing the Gaussians", 0.1)
    tensors, quad = pack_gaussians(gaussians.take(rows), centre), shader("fullscreen.vert", WEB)
    defines = displays.shader_defines()
    meta: dict[str, Any] = {
        "title": title,
        "address": urlencode({"phrase": phrase, "show": "relevancy"}) if phrase else "",
        "origin": scene.in_world(centre).tolist(),
        "radius": radius,
        "up": scene.up().tolist(),
        "metres_per_unit": scene.metres_per_unit,
        "raster": asdict(scene.raster_settings()),
        "sh_count": gaussians.sh.shape[1],
        "views": [
            {
                "name": camera.name or f"view {number}",
                **vars(camera.intrinsics),
                "rotation": camera.rotation.ravel().tolist(),
                "position": (camera.position - centre).tolist(),
            }
            for number, camera in enumerate(seen_from)
        ],
        "notes": [{"text": text, "at": (np.array(at) - centre).tolist()} for text, at in notes],
        "picture": {
            **asdict(PictureConfig()),
            "displays": {name: row.drawing for name, row in displays.DISPLAYS.items()},
            "strength": dict(displays.STRENGTH),
            "heat_base": displays.HEAT_BASE,
            "maps": list(displays.COLOUR_MAPS),
        },
        "query_colours": displays.QUERY_COLOURS.tolist(),
        "shaders": {  # vertex and fragment shader of each pass
            "project": [quad, shader("project.frag", WEB)],
            "splat": splat_shaders(2, False, WEB),
            "compose": [quad, shader("compose.frag", WEB, "langsplat_core.display", **defines)],
        },
    }
    tensors["colour_maps"] = np.stack(list(displays.COLOUR_MAPS.values()))
    why_not = unsearchable(engine) if engine else no_field(scene).partition(": ")[2]
    language: dict[str, Any] = {}
    if engine is not None and not why_not:
        language, own = language_tables(engine, rows, progress)
        tensors |= own
    meta |= {"language": language or None, "why_not": why_not}
    progress("compressing", 0.8)
    plain = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    packed = zlib.compress(save(plain, {"page": json.dumps(meta, allow_nan=False)}))
    image, still = render(scene, seen_from[0].within(STILL)), BytesIO()  # is seen until the scene is drawn
    pixels = compose(displays.Channels(image.colours, image.alpha, None), PictureConfig())
    Image.fromarray(pixels).save(still, "JPEG", quality=85)
    text = page_text(title, packed, still.getvalue())
    free = "encoder" in language
    return text, PageReport(len(rows), len(language.get("phrases", ())), free, len(text.encode()), why_not)


def unsearchable(engine: QueryEngine) -> str:
    """Return why a page of a scene with a language field cannot answer; "" where it can."""
    if engine.field.codec.blends:
        return (
            f"its language field is {engine.field.codec.kind!r}, not a codebook: train it with "
            "--codec.kind codebook to search it in a page"
        )
    if engine.rule != "regions":
        return "a page answers by everyday phrases, and neither the scene nor an encoder here has them"
    return ""


# The Gaussians: every column in 8 or 16 bits between the least and the largest value of its chunk.


def pack_gaussians(gaussians: Gaussians, centre: Array) -> dict[str, Array]:
    """Return the columns of the Gaussians in 8 or 16 bits.

    `low` and `high` are (C, M) uint8 bytes of the columns, high ones of the first `WIDE` alone; `ranges` are
    (C, M / CHUNK, 2) float32. Columns are as listed here, means relative to `centre`.
    """
    count = len(gaussians)
    columns = np.concatenate(
        [
            gaussians.means - centre,
            gaussians.log_scales.clip(FLATTEST, -FLATTEST),
            unit(gaussians.quats_wxyz.astype(np.float64), 1e-30),
            gaussians.opacity_logits.clip(-OPAQUE, OPAQUE)[:, None],
            gaussians.sh.reshape(count, -1),
        ],
        axis=1,
    ).T
    chunks = -(-count // CHUNK)
    edge = np.pad(columns, ((0, 0), (0, chunks * CHUNK - count)), mode="edge")
    edge = edge.reshape(len(columns), -1, CHUNK)
    ranges = np.stack([edge.min(2), edge.max(2)], -1).astype(np.float32)
    steps = np.where(np.arange(len(columns)) < WIDE, 65_535, 255)[:, None, None]
    low = ranges[..., :1].astype(np.float64)
    span = np.maximum(ranges[..., 1:].astype(np.float64) - low, 1e-30)
    numbers = np.rint(((edge - low) / span).clip(0, 1) * steps).astype(np.uint16)
    numbers = numbers.reshape(len(columns), -1)[:, :count]
    return {
        "low": (numbers & 255).astype(np.uint8),
        "high": (numbers[:WIDE] >> 8).astype(np.uint8),
        "ranges": ranges,
    }


def views(scene: Scene, first: Sequence[Camera] = ()) -> tuple[Camera, ...]:
    """Return the views of a page: `first` and the scene's cameras; without any, one that holds it."""
    step = -(-len(scene.cameras) // 200)  # views at most
    others = (camera for camera in scene.cameras[:: step or 1] if camera not in first)
    if kept := tuple(camera for camera in (*first, *others) if not camera.orthographic):
        return kept
    camera = scene.framing_camera((1280, 800))
    matrix = camera.world_to_camera.copy()
    places = scene.gaussians.means[scene.gaussians.valid()] @ matrix[:3, :3].T + matrix[:3, 3]
    middle = np.quantile(places, (0.005, 0.995), axis=0).mean(0)[:2]  # without floaters
    sides = np.abs(places[:, :2] - middle) * (camera.fx / camera.width, camera.fy / camera.height) / 0.45
    matrix[:3, 3] += *-middle, np.quantile(sides.max(1) - places[:, 2], 0.99)  # with a margin
    return (replace(camera, world_to_camera=matrix),)


# The language field.


def language_tables(
    engine: QueryEngine, rows: Array, progress: Progress = silent
) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the numbers, words and tensors that answers need; rows: (M,) Gaussians of the page."""
    field, regions = engine.field, engine.regions
    codebook = field.codec.decode(np.arange(field.codec.size)[:, None])
    scale = engine.scale
    zero, rate = scale.of(codebook @ scale.texts.T)
    codes = np.where(field.known, field.latents[..., 0], len(codebook))
    inside, first = regions.everywhere[:, rows], np.cumsum([0, *map(len, regions.nodes[:-1])], dtype=np.int32)
    palette = field.codec.colours(np.arange(len(codebook), dtype=np.uint16)[:, None], np.ones(len(codebook)))
    is_calibrated = engine.calibration is not None and not engine.taught  # whatever is asked
    tensors: dict[str, Array] = {
        "codebook": codebook.astype(np.float16),
        "zero": zero,
        "rate": rate,
        "codes": codes[:, rows].astype(np.uint16),
        "regions": np.where(inside < 0, -1, inside + first[:, None]),
        "palette": to_bytes(255 * palette),
        "surface": (regions.weights[rows] > 0).astype(np.uint8),
        "chance": np.array(() if engine.chance is None or is_calibrated else engine.chance, np.float16),
        **_region_tables(engine, codes),
    }
    found = {name: [None if np.isinf(x) else x for x in pair] for name, pair in RULE.found.items()}
    progress("choosing phrases", 0.3)
    suggested = suggest(engine)
    numbers: dict[str, Any] = {
        "levels": LEVELS,
        "counts": [len(nodes) for nodes in regions.nodes],
        "basis": engine.basis.long,
        "guess": engine.basis.short if engine.basis.guesses else "",
        "bars": [asdict(bar) for bar in engine.bars or ()],
        "calibration": None if engine.calibration is None else asdict(engine.calibration),
        "rule": asdict(RULE) | {"found": found, "half": HALF, "low": LOW},
        "grammar": {name.lower(): sorted(getattr(grammar, name)) for name in LISTS}
        | {name.lower(): getattr(grammar, name) for name in TABLES},
        "space": {name.lower(): getattr(relations, name) for name in NUMBERS}
        | {"half": HALF, "inner": INNER},
        "frame": relations.upright(engine.scene.up()).ravel().tolist(),
        "examples": suggested.examples,
        "phrases": suggested.phrases,
    }
    names = [word.name for word in engine.taught.values()]
    fits = [np.concatenate(taught.likeness(word, engine.word_space)[0]) for word in engine.taught.values()]
    tensors["taught_fits"] = np.reshape(fits, (len(fits), sum(numbers["counts"]))).astype(np.float32)
    each = [[_shown(engine, name, level, first) for level in get_args(LevelChoice)] for name in names]
    numbers["taught"] = [{"name": name, "answers": own} for name, own in zip(names, each, strict=True)]
    progress("encoding words", 0.6)
    words, own = _words(engine, suggested.phrases)
    return numbers | words, tensors | own


def _shown(engine: QueryEngine, name: str, level: LevelChoice, first: Array) -> dict[str, Any]:
    """Return the answer to a taught word, with the numbers of its regions; first: those of the levels."""
    answer = engine.run(name, level)
    inside = np.unique(engine.regions.everywhere[answer.level, answer.members]) + first[answer.level]
    numbers = {"level": answer.level, "scores": answer.scores, "fits": answer.fits}
    return numbers | {"inside": inside.tolist(), "margin": answer.judgement.margin}


def _region_tables(engine: QueryEngine, codes: Array) -> dict[str, Array]:
    """Return tensors of all regions, those of subparts first; codes: (3, N), the last for no codeword.

    `share_of`, `share_code` and `share` are a sparse matrix that takes relevancies of codewords to means of
    regions; beside it sizes, parents, places and boxes in the world, corners relative to the page's origin.
    """
    regions, scene, (centre, _) = engine.regions, engine.scene, engine.scene.bounds()
    means, count = scene.gaussians.means, sum(map(len, regions.nodes))
    places, boxes, corners = np.empty((count, 3)), np.empty((count, 2, 3)), np.empty((count, 8, 3))
    for level, sizes in enumerate(regions.sizes):
        order = regions.counts[np.argsort(regions.everywhere[level, regions.counts], kind="stable")]
        each = np.split(order, np.cumsum(sizes)[:-1]) if len(sizes) else []
        for region, own in enumerate(each, sum(map(len, regions.nodes[:level]))):
            places[region], boxes[region] = place_of(means[own])
            corners[region] = oriented_box(means[own[:: -(-len(own) // BOXED)]] - centre).corners
    share = regions.mixtures(codes, engine.field.codec.size + 1)[:, :-1].tocoo()
    return {
        "share_of": share.row.astype(np.uint32),
        "share_code": share.col.astype(np.uint16),
        "share": share.data.astype(np.float32),
        "sizes": np.concatenate(regions.sizes).astype(np.uint32),
        "parents": regions.table.parents.astype(np.int32),
        "touching": (engine.touching + count - len(regions.nodes[-1])).astype(np.int32),
        "places": scene.in_world(places),
        "boxes": scene.in_world(boxes).reshape(count, 6),
        "corners": corners.astype(np.float32).reshape(count, 24),
    }


def _words(engine: QueryEngine, suggested: Sequence[str]) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the phrases whose vectors are in the page, and the encoder where it is small enough."""
    book = tuple(engine.field.phrasebook)
    try:
        encoder: TextEncoder | None = engine.texts.encoder()
    except EncoderError:
        encoder = None
    plain = encoder.tower if isinstance(encoder, PhraseEncoder) else None
    if isinstance(plain, PlainClipText) and isinstance(encoder, PhraseEncoder) and encoder.words:
        config = asdict(plain.config)
        ends = {"begin": plain.tokenizer.begin, "end": plain.tokenizer.end}
        ids = {word: plain.tokenizer.encode(word) for word in sorted(encoder.words)}
        tensors = {f"encoder.{name}": tensor.astype(np.float16) for name, tensor in plain.tensors.items()}
        _, vectors = engine.texts.of_known(book)
        encoding = {"config": config, "words": ids, **ends}
        return {"keys": book, "encoder": encoding}, tensors | {"vectors": vectors.astype(np.float16)}
    phrases: Sequence[str] = book
    if encoder is not None:
        phrases = (*book, *suggested, *(phrase for name in BUNDLED for phrase in bundled_vocabulary(name)))
    others = (name for phrase in phrases for name in grammar.thing_and_part(phrase) if name)
    known, vectors = engine.texts.of_known((*phrases, *others))
    return {"keys": known, "phrases": known if encoder else book}, {"vectors": vectors.astype(np.float16)}


# The file.


def page_text(title: str, data: bytes, still: bytes) -> str:
    """Return the HTML file, whose policy lets only its own script run, and nothing be fetched."""
    folder = files("langsplat_core") / "web"
    modules = [folder.joinpath(f"{name}.js").read_text(encoding="utf-8") for name in MODULES]
    bodies = (module.split(BEGIN)[1] for module in modules)
    script = "\n".join(re.sub("^export ", "", body, flags=re.MULTILINE) for body in bodies)
    style = folder.joinpath("page.css").read_text(encoding="utf-8")
    script_hash, style_hash = (
        base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (script, style)
    )
    policy = (
        f"default-src 'none'; script-src 'sha256-{script_hash}'; style-src 'sha256-{style_hash}'; "
        "worker-src blob:; img-src data:; base-uri 'none'; form-action 'none'"
    )
    filled = {
        "POLICY": policy,
        "TITLE": html.escape(title),
        "STYLE": style,
        "SCRIPT": script,
        "STILL": base64.b64encode(still).decode(),
        "DATA": base64.b64encode(data).decode(),
    }
    page = folder.joinpath("page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filled[found[1]], page)
