"""Report of a training: `report.json` and the page `report.html` in its work folder; read without torch.

The page is one file, whose only script moves the line between a photograph and what the scene shows there:
its content is allowed by its hash. Names and other text of whatever origin are escaped.
"""

import hashlib
import html
import io
import json
from base64 import b64encode
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, ViewScore, affine
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.workspace import Matches
from langsplat_core.errors import FormatError, InputError, printable_line
from langsplat_core.io.files import write_json, write_whole
from langsplat_core.io.hostile import read_json_file
from langsplat_core.io.quantised import to_bytes
from langsplat_core.raster.render import render
from langsplat_core.scene import Camera, Scene

REPORT, PAGE = "report.json", "report.html"
PREVIEW = "so-far.ply"  # in the work folder: Gaussians that the window shows of a training under way
APART = 10.0  # times the median step to a neighbouring camera; captures that went well have at most 5


@dataclass(frozen=True)
class TrainReport:
    """Figures of a training."""

    views: int
    held_out: int
    gaussians: int
    psnr: float | None  # mean over held-out views, dB; None without held-out views
    warnings: tuple[str, ...]  # quality warnings, each with its remedy
    seconds: dict[str, float]  # per stage, of all processes that worked on it, interrupted ones too
    masks: str = ""  # name of the mask source; "" without a language field, as what follows
    encoder: str = ""
    mask_count: int = 0
    codec: str = ""  # its kind
    codec_size: int = 0  # codewords of a codebook, numbers per latent of other kinds
    codec_cosine: float = 0.0  # mean cosine of Gaussians' vectors with their decoded latents
    relevancy_error: float = 0.0  # mean absolute error of decoded latents, over everyday phrases
    relevancy_error_p99: float = 0.0
    observed: float = 0.0  # fraction of Gaussians with language features at the whole level
    dataset: str = ""  # absolute path of the photographs; "" in reports of earlier versions
    contents: Mapping[str, str] = field(default_factory=dict)  # of the photographs, see `Capture.contents`
    held_out_views: tuple[ViewScore, ...] = ()  # one by one
    psnr_small: float | None = None  # as `psnr`, of images shrunk to 320 px, by which presets compare
    psnr_trained: float | None = None  # mean over the views that were trained on, 48 of them at most
    held_out_rule: str = ""  # which views are held out, in words
    taken: str = ""  # the span of the photographs' dates and places, in words


def work_folder(out: Path) -> Path:
    """Return the default folder in which the training of a scene keeps its stages."""
    return out.with_name(f"{out.stem}.work")


def read_report(work: Path) -> TrainReport:
    """Read the report of the run which has just ended, in this process or another."""
    return msgspec.convert(json.loads((work / REPORT).read_bytes()), TrainReport)


def stated_figures(path: Path) -> dict[str, Any]:
    """Return the content of a report, which is not trusted; {} where there is none or it cannot be read."""
    try:
        stated = read_json_file(path, limit=8_000_000)
    except (InputError, FormatError):
        return {}
    return stated if isinstance(stated, dict) else {}


def stated_warnings(scene: Path, gaussians: int) -> tuple[str, ...]:
    """Return the first quality warnings of the report beside a scene, if it has as many Gaussians."""
    stated = stated_figures(work_folder(scene) / REPORT)
    lines = stated.get("warnings") if stated.get("gaussians") == gaussians else None
    if not isinstance(lines, list):
        return ()
    return tuple(printable_line(line, 300) for line in lines[:5] if isinstance(line, str))


def quality_warnings(
    capture: Capture, train: Sequence[int], held_out: Sequence[ViewScore], trained: Sequence[ViewScore]
) -> tuple[str, ...]:
    """Return a sentence with a remedy for each sign of a poor scene.

    train: rows of the photographs that were trained on; held_out, trained: scores of views of each kind.
    """
    cameras, matches = [capture.cameras[index] for index in train], capture.matches
    psnr, learnt = (float(np.mean([s.psnr for s in each] or [np.nan])) for each in (held_out, trained))
    covered = float(np.mean([score.covered for score in held_out] or [1.0]))
    positions = np.array([camera.position for camera in cameras]).reshape(-1, 3)
    groups = camera_groups(positions)
    seen = [(camera.in_image(*at), at[1]) for camera in cameras for at in [camera.project(capture.points)]]
    points = float(np.median([int(inside.sum()) for inside, _ in seen] or [0]))
    depth = float(np.median(np.concatenate([z[inside] for inside, z in seen]))) if points else np.nan
    beside = float(np.linalg.norm(positions[:, None] - positions, axis=2).max(initial=0)) / depth
    readable = 0 if matches is None else sum(count >= 0 for count in matches.features)
    lost = 0 if matches is None else readable - len(matches.located)
    found = {
        f"held-out photographs are reproduced at {psnr:.1f} dB, below 16: cameras may "
        "be wrong, or photographs too few; take more that overlap, or give COLMAP's cameras": psnr < 16,
        f"only {100 * covered:.0f} % of the held-out pictures' pixels show anything: photograph "
        "what is there from more sides, or train for more steps": covered < 0.5,
        f"even photographs that were trained on are reproduced at {learnt:.1f} dB, below 22: leaves, water "
        "or what is far away hold more than fits; take a larger preset, or photograph from nearer": learnt
        < 22,
        f"held-out photographs are reproduced {learnt - psnr:.1f} dB worse than those that were trained on: "
        "these are learnt by heart; take more photographs between them": learnt - psnr > 6,
        f"a photograph sees only {points:.0f} points that others see (the median): cameras may be wrong by "
        "pixels; take sharper photographs, and more that share two thirds of their view": 0 < points < 100,
        f"the cameras stand within {100 * beside:.1f} % of the distance to what they see: depths are hardly "
        "known; step aside between photographs, by a tenth of that distance in all and more": beside < 0.1,
        f"{lost} of {readable} photographs could not be located: the scene lacks what they show; "
        f"{matches.advice() if matches and lost else ''}": lost > readable / 4,
        f"the cameras stand in {len(groups)} groups far apart "
        f"({' and '.join(str(len(group)) for group in groups)} photographs): they may not belong "
        "together; add photographs between them, or train each group alone": len(groups) > 1,
    }
    return tuple(warning for warning, holds in found.items() if holds)


def camera_groups(positions: Array) -> list[Array]:
    """Return groups of two or more of (M, 3) positions that lie `APART`, as rows, the largest first."""
    from scipy.cluster.hierarchy import fcluster, linkage

    whole = [np.arange(len(positions))]
    if len(positions) < 4:
        return whole
    links = linkage(positions, "single")  # whose distances are the steps of a minimum spanning tree
    steps = links[links[:, 2] > 0, 2]
    if len(steps) == 0:
        return whole
    labels = fcluster(links, APART * np.median(steps), "distance")
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    return sorted((group for group in groups if len(group) > 1), key=len, reverse=True) or whole


# The page.

MOST_VIEWS = 48  # on the page, held-out ones first
SIDE = 400  # px, longer side of an image
PLOT, WEDGE = 640, 17  # units of a drawing's side, and of the way that a camera looks
SLIDE = 'oninput = ({ target }) => target.parentNode.style.setProperty("--at", target.value + "%");'


def shown_views(train: Sequence[int]) -> list[int]:
    """Return the views that are measured and shown of those that were trained on, spread over all."""
    rows = np.linspace(0, len(train) - 1, min(len(train), MOST_VIEWS)).round().astype(int)
    return [train[row] for row in rows]


def write_reports(
    work: Path, report: TrainReport, capture: Capture, scene: Scene, trained: Sequence[ViewScore]
) -> None:
    """Write the report of a finished training, as JSON and as a page; trained: scores of `shown_views`."""
    write_json(work / REPORT, asdict(report))
    held_out = {score.name: score for score in report.held_out_views[:MOST_VIEWS]}
    rows = {camera.name: index for index, camera in enumerate(capture.cameras)}
    scores = [*held_out.values(), *trained][:MOST_VIEWS]
    scene = replace(scene, cameras=capture.cameras)
    views = (_view(capture, scene, rows[score.name], score, score.name in held_out) for score in scores)
    more = len(capture) - len(scores)
    head = files("langsplat_core").joinpath("web", "report.html").read_text(encoding="utf-8")
    digest = b64encode(hashlib.sha256(SLIDE.encode()).digest()).decode()
    head = head.replace("{{SCRIPT}}", SLIDE).replace("{{DIGEST}}", digest)
    cards = (
        f"<div class='card warning'><b>{_text(fault + colon, 600)}</b> {_text(remedy, 1000)}</div>"
        for fault, colon, remedy in (warning.partition(": ") for warning in report.warnings)
    )
    parts = [
        head.replace("{{TITLE}}", _text(Path(report.dataset).name or "Training")),
        _tiles(report), *cards, "<div class=halves>",
        _section("Cameras from above", _from_above(scene, held_out)), _figures(report, capture.matches),
        "</div><h2>Photographs, and what the scene shows there</h2>",
        "<p class=soft>Left of the line the photograph, right the scene: drag it. Held-out photographs, not "
        f"trained on, come first{f'; {more} more are not shown' if more else ''}.</p>",
        "<div class=views>", *views, "</div>",
    ]  # fmt: skip
    write_whole(work / PAGE, "\n".join(parts))


def _text(text: object, limit: int = 120) -> str:
    return html.escape(printable_line(text, limit))


def _section(title: str, content: str) -> str:
    return f"<div><h2>{title}</h2><div class=card>{content}</div></div>"


def _tiles(report: TrainReport) -> str:
    scores = report.held_out_views
    tiles = {
        "photographs": report.views + report.held_out,
        f"held out{report.held_out_rule and ', '}{_text(report.held_out_rule)}": report.held_out,
        "held-out PSNR": "none" if report.psnr is None else f"{report.psnr:.1f} dB",
        "PSNR at 320 px": "none" if report.psnr_small is None else f"{report.psnr_small:.1f} dB",
        "PSNR of training views": "none" if report.psnr_trained is None else f"{report.psnr_trained:.1f} dB",
        "held-out SSIM": f"{np.mean([s.ssim for s in scores]):.3f}" if scores else "none",
        "Gaussians": f"{report.gaussians:,}",
        "masks": f"{report.mask_count:,}",
        "in all runs": f"{sum(report.seconds.values()):.0f} s",
    }
    cards = "".join(f"<div class=card><b>{value}</b>{name}</div>" for name, value in tiles.items())
    about = "<br>".join(_text(line, 400) for line in (report.dataset, report.taken) if line)
    return f"<p class=soft>{about}</p><div class='tiles soft'>{cards}</div>"


def _figures(report: TrainReport, matches: Matches | None) -> str:
    found = "not sought: cameras were given"
    if matches is not None:
        found = f"{len(matches.located)} of {len(matches.names)} photographs are located"
        found += f"; {matches.advice()}" if matches.gap else ""
    figures = {name: f"{seconds:.1f} s" for name, seconds in report.seconds.items()}
    figures["matches"] = found
    described = {
        "masks by": report.masks,
        "encoder": report.encoder,
        "codec": f"{report.codec} of {report.codec_size}, mean cosine {report.codec_cosine:.4f}",
        "relevancy error": f"{report.relevancy_error:.4f} (99 % below {report.relevancy_error_p99:.3f})",
        "Gaussians with language features": f"{100 * report.observed:.1f} %",
    }
    figures |= described if report.masks else {}
    cells = (f"<tr><td>{_text(name, 1000)}<td>{_text(value, 300)}" for name, value in figures.items())
    return _section("Stages and figures", f"<table>{''.join(cells)}</table>")


def _view(capture: Capture, scene: Scene, index: int, score: ViewScore, held: bool) -> str:
    camera, photo, mask = capture.cameras[index], capture.images[index], capture.mask(index)
    small = camera.within(SIDE)
    if mask is not None:  # what does not count is faint
        photo = np.where(mask[..., None], photo, 200 + photo // 5).astype(np.uint8)
    drawn = to_bytes(255 * render(scene, small).colours)
    photograph = Image.fromarray(np.ascontiguousarray(photo)).resize((small.width, small.height))
    badge = " <span class=badge>held out</span>" if held else ""
    return (
        f"<div class='card{' held' if held else ''}'><div class=name><span>{_text(camera.name)}{badge}</span>"
        f"<span class=soft>{score.psnr:.1f} dB, SSIM {score.ssim:.3f}</span></div>"
        f"<div class=pair><img alt=photograph src='{_uri(np.asarray(photograph))}'><img alt=scene "
        f"src='{_uri(drawn)}'><input type=range aria-label='where the scene begins'></div></div>"
    )


def _uri(pixels: Array) -> str:
    packed = io.BytesIO()
    Image.fromarray(pixels).save(packed, "JPEG", quality=80)
    return f"data:image/jpeg;base64,{b64encode(packed.getvalue()).decode()}"


def _from_above(scene: Scene, held_out: Container[str]) -> str:
    """Draw the cameras, and the scene below them, from above."""
    plan = _camera_above(scene)
    ground = render(scene, plan)
    shade = 1 - 0.75 * (ground.alpha[..., None] - ground.colours).clip(0, 1)  # faint, as a map's ground
    drawn = [f"<image width='{plan.width}' height='{plan.height}' href='{_uri(to_bytes(255 * shade))}'/>"]
    for camera in scene.cameras:
        place = plan.project(camera.position[None])[0][0]
        # A wedge for what a camera looks towards; one that looks straight down is its dot alone.
        ahead = plan.rotation[:2] @ camera.rotation[2]
        across = np.array([-ahead[1], ahead[0]]) * min(0.5 * camera.width / camera.fx, 1.0)
        corners = (place, place + WEDGE * (ahead + across), place + WEDGE * (ahead - across))
        drawn.append(
            f"<g fill='{'#e07b00' if camera.name in held_out else '#3b6fb6'}'>"
            f"<title>{_text(camera.name)}</title><circle cx='{place[0]:.1f}' cy='{place[1]:.1f}' r='3.4'/>"
            f"<polygon fill-opacity='.45' points='{' '.join(f'{x:.1f},{y:.1f}' for x, y in corners)}'/></g>"
        )
    key = "".join(
        f"<span class='soft key'><i style='background:{colour}'></i>{name}</span>"
        for colour, name in (("#3b6fb6", "trained on"), ("#e07b00", "held out"), ("#b9c0ca", "Gaussians"))
    )
    return f"<svg viewBox='0 0 {plan.width} {plan.height}' role=img>{''.join(drawn)}</svg>{key}"


def _camera_above(scene: Scene) -> Camera:
    """Return an orthographic camera over all cameras, with their longest extent across its image."""
    up = scene.up()
    eyes = np.array([camera.position for camera in scene.cameras])
    flat = (eyes - eyes.mean(0)) - np.outer((eyes - eyes.mean(0)) @ up, up)
    right = np.linalg.svd(flat)[2][0]
    rotation = np.stack([right - (right @ up) * up, -np.cross(up, right), -up])
    places = eyes @ rotation[:2].T
    points = scene.gaussians.means[scene.gaussians.valid()].astype(np.float64) @ rotation[:2].T
    most = np.quantile(points, (0.02, 0.98), axis=0) if len(points) else places
    low, high = np.minimum(places.min(0), most[0]), np.maximum(places.max(0), most[-1])
    margin = max(0.06 * float((high - low).max()), 1e-30)
    low, high = low - margin, high + margin
    scale = PLOT / float((high - low).max())
    width, height = np.maximum((high - low) * scale, 1).round().astype(int).tolist()
    corner = (*low, (eyes @ rotation[2]).min() - scene.near) @ rotation
    pose = affine(rotation, -rotation @ corner)
    return Camera(width, height, scale, scale, 0.0, 0.0, pose, orthographic=True)
