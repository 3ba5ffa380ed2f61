"""Page of a training, `report.html` in its work folder, in one file without scripts.

It shows photographs beside what the scene shows, cameras from above, the graph of matches, warnings and
figures.
"""

import html
import io
from base64 import b64encode
from collections.abc import Container, Iterable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.arrays import Array, ViewScore, sigmoid
from langsplat_core.datasets.capture import Capture
from langsplat_core.datasets.workspace import FEWEST_MATCHES, Matches, NotLocatedError
from langsplat_core.errors import printable_line
from langsplat_core.io.files import atomic_path
from langsplat_core.pipeline.report import PAGE, TrainReport, camera_groups, rehearsals_in_words, write_report
from langsplat_core.raster.render import render
from langsplat_core.scene import Gaussians, Scene
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.scores import evaluate_views

MOST_VIEWS = 48  # on the page, held-out ones first
SIDE = 400  # px, longer side of an image
QUALITY = 80  # of JPEG
MAP_SIDE = 220  # cells of the map, along its longer side
PLOT = 640  # units of a drawing's side
STRONGEST = 8  # lines that a photograph adds to the graph of matches
NAMED = 64  # photographs up to which each is named in the graph
_BLUE, _ORANGE, _RED = "#3b6fb6", "#e07b00", "#c62f3c"


def write_reports(work: Path, report: TrainReport, capture: Capture, gaussians: Gaussians) -> None:
    """Write the report of a finished training, as JSON and as a page."""
    write_report(work, report)
    held_out = {score.name: score for score in report.held_out_views[:MOST_VIEWS]}
    rows = {camera.name: index for index, camera in enumerate(capture.cameras)}
    measured = {rows[score.name] for score in report.held_out_views}
    others = from_all_over(sorted(set(rows.values()) - measured), MOST_VIEWS - len(held_out))
    scores = [*held_out.values(), *evaluate_views(gaussians, capture, others)]
    scene = Scene(gaussians, cameras=capture.cameras)
    views = (_view(capture, scene, rows[score.name], score, score.name in held_out) for score in scores)
    more = len(capture) - len(scores)
    colours = _key(_BLUE, "trained on") + _key(_ORANGE, "held out") + _key("#b9c0ca", "Gaussians")
    graph = [_matches(capture.matches)] if capture.matches else []
    _write(work / PAGE, Path(report.dataset).name or "Training", [
        _tiles(report), *_warnings(report.warnings), "<div class=halves><div>",
        _section("Cameras from above", _from_above(scene, held_out), colours), *_figures(report),
        "</div>", *graph, "</div><h2>Photographs, and what the scene shows there</h2>",
        "<p class=soft>Left the photograph, right the scene. Held-out photographs, which were not trained "
        f"on, come first{f'; {more} more are not shown' if more else ''}.</p>",
        "<div class=views>", *views, "</div>",
    ])  # fmt: skip


def write_refusal(work: Path, error: NotLocatedError) -> Path:
    """Write the page of a training that ended without cameras, and return its path."""
    matches = error.matches
    groups = (
        f"<tr><td class=number>{len(group)}<td>{', '.join(_text(matches.names[row], 60) for row in group)}"
        f"<td class=soft>{'located' if group[0] in matches.located else matches.why(group[0])}"
        for group in matches.groups
    )
    _write(work / PAGE, "Too few photographs could be located", [
        f"<div class='card warning'>{_text(error, 1000)}</div><div class=halves>", _matches(matches),
        _section("Groups", f"<table><tr><th>size<th>photographs<th>why{''.join(groups)}</table>"), "</div>",
    ])  # fmt: skip
    return work / PAGE


def from_all_over(rows: Sequence[int], most: int) -> list[int]:
    """Return at most `most` of `rows`, evenly spaced."""
    return [rows[at] for at in np.linspace(0, len(rows) - 1, min(len(rows), most)).round().astype(int)]


def _write(path: Path, title: str, parts: Iterable[str]) -> None:
    head = (
        "<!doctype html><html lang=en><meta charset=utf-8><meta http-equiv=Content-Security-Policy "
        "content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">"
        f"<meta name=viewport content='width=device-width'><title>{_text(title)}</title>"
        f"<style>{files('langsplat_core.web').joinpath('report.css').read_text(encoding='utf-8')}</style>"
        f"<h1>{_text(title)}</h1>"
    )
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(f"{part}\n" for part in (head, *parts))


def _text(text: object, limit: int = 120) -> str:
    """Return text of whatever origin as HTML."""
    return html.escape(printable_line(text, limit))


def _section(title: str, *parts: str) -> str:
    return f"<div><h2>{title}</h2><div class=card>{''.join(parts)}</div></div>"


def _key(colour: str, name: str) -> str:
    return f"<span class='soft key'><i style='background:{colour}'></i>{name}</span>"


def _warnings(warnings: Iterable[str]) -> Iterator[str]:
    """Yield a card for each warning, in which the remedy stands behind the colon."""
    for warning in warnings:
        fault, colon, remedy = warning.partition(": ")
        yield f"<div class='card warning'><b>{_text(fault + colon, 600)}</b> {_text(remedy, 1000)}</div>"


def _tiles(report: TrainReport) -> str:
    scores = report.held_out_views
    tiles = {
        "photographs": report.views + report.held_out,
        "held out": report.held_out,
        "held-out PSNR": "none" if report.psnr is None else f"{report.psnr:.1f} dB",
        "PSNR at 320 px": "none" if report.psnr_small is None else f"{report.psnr_small:.1f} dB",
        "held-out SSIM": f"{np.mean([s.ssim for s in scores]):.3f}" if scores else "none",
        "Gaussians": f"{report.gaussians:,}",
        "masks": f"{report.mask_count:,}",
        "in all": f"{sum(report.seconds.values()):.0f} s",
    }
    cards = "".join(f"<div class=card><b>{value}</b>{name}</div>" for name, value in tiles.items())
    return f"<p class=soft>{_text(report.dataset, 400)}</p><div class='tiles soft'>{cards}</div>"


def _figures(report: TrainReport) -> Iterator[str]:
    longest = max(report.seconds.values(), default=1) or 1
    stages = "".join(
        f"<tr><td>{_text(name)}<td class=number>{seconds:.1f} s"
        f"<td style='width:55%'><div class=bar style='width:{100 * seconds / longest:.1f}%'></div>"
        for name, seconds in report.seconds.items()
    )
    figures = {
        "rehearsed": rehearsals_in_words(report.rehearsed) or "no",
        "masks": report.masks,
        "encoder": report.encoder,
        "codec": f"{report.codec} of {report.codec_size}, mean cosine {report.codec_cosine:.4f}",
        "relevancy error": f"{report.relevancy_error:.4f} (99 % below {report.relevancy_error_p99:.3f})",
        "Gaussians with language features": f"{100 * report.observed:.1f} %",
    }
    rows = "".join(f"<tr><td>{name}<td>{_text(value, 300)}" for name, value in figures.items())
    yield _section("Seconds per stage", f"<table>{stages}</table>")
    yield _section("Figures", f"<table>{rows}</table>")


def _view(capture: Capture, scene: Scene, index: int, score: ViewScore, held: bool) -> str:
    camera, photo, mask = capture.cameras[index], capture.images[index], capture.mask(index)
    scale = min(1.0, SIDE / max(camera.width, camera.height))
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    if mask is not None:  # what does not count is faint
        photo = np.where(mask[..., None], photo, 200 + photo // 5).astype(np.uint8)
    drawn = render(scene, camera.resized(*size)).colours.clip(0, 1)
    photograph = Image.fromarray(np.ascontiguousarray(photo)).resize(size)
    image = Image.fromarray((drawn * 255 + 0.5).astype(np.uint8))
    badge = " <span class=badge>held out</span>" if held else ""
    return (
        f"<div class='card{' held' if held else ''}'><div class=name><span>{_text(camera.name)}{badge}</span>"
        f"<span class=soft>{score.psnr:.1f} dB, SSIM {score.ssim:.3f}</span></div>"
        f"<div class=pair><img alt=photograph src='{_uri(photograph)}'><img alt=scene src='{_uri(image)}'>"
        "</div></div>"
    )


def _uri(image: Image.Image) -> str:
    packed = io.BytesIO()
    image.save(packed, "JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{b64encode(packed.getvalue()).decode()}"


# Cameras from above.


def _from_above(scene: Scene, held_out: Container[str]) -> str:
    """Draw the cameras and the Gaussians from above, with the cameras' longest way across the page."""
    up, eyes = scene.up(), np.array([camera.position for camera in scene.cameras])
    flat = (eyes - eyes.mean(0)) - np.outer((eyes - eyes.mean(0)) @ up, up)
    right = np.linalg.svd(flat)[2][0]
    axes = np.stack([right - (right @ up) * up, np.cross(up, right)])  # right and, on the page, up
    gaussians = scene.gaussians.take(np.flatnonzero(scene.gaussians.valid()))
    points, places = gaussians.means.astype(np.float64) @ axes.T, eyes @ axes.T
    low, high = places.min(0), places.max(0)
    margin = max(float((high - low).max()), 1e-6)
    if len(points):
        near, far = np.quantile(points, (0.05, 0.95), axis=0)
        low, high = np.clip(near, low - margin, low), np.clip(far, high, high + margin)
    low, high = low - 0.06 * margin, high + 0.06 * margin
    scale = PLOT / float((high - low).max())
    width, height = (high - low) * scale

    def at(place: Array) -> Array:
        return np.asarray((place - low) * scale * (1, -1) + (0, height))

    drawn = [_map(at(points), gaussians, width, height), *_group_rings(eyes, at(places))]
    for camera, place in zip(scene.cameras, at(places), strict=True):
        # A wedge for what a camera looks towards; one that looks straight down is its dot alone.
        ahead = axes @ camera.rotation[2] * (1, -1)
        across = np.array([-ahead[1], ahead[0]]) * min(0.5 * camera.width / camera.fx, 1.0)
        corners = (place, place + 17 * (ahead + across), place + 17 * (ahead - across))
        drawn.append(
            f"<g fill='{_ORANGE if camera.name in held_out else _BLUE}'><title>{_text(camera.name)}</title>"
            f"<circle cx='{place[0]:.1f}' cy='{place[1]:.1f}' r='3.4'/><polygon fill-opacity='.45' "
            f"points='{' '.join(f'{x:.1f},{y:.1f}' for x, y in corners)}'/></g>"
        )
    return f"<svg viewBox='0 0 {width:.0f} {height:.0f}' role=img>{''.join(drawn)}</svg>"


def _map(places: Array, gaussians: Gaussians, width: float, height: float) -> str:
    """Draw the mean colours of Gaussians at `places` (N, 2) on the page, faint as a map's ground."""
    cell = max(width, height) / MAP_SIDE
    rows, columns = max(1, int(np.ceil(height / cell))), max(1, int(np.ceil(width / cell)))
    opacities = sigmoid(gaussians.opacity_logits)
    colours = (0.5 + C0 * gaussians.sh[:, 0]).clip(0, 1)
    edges = (0, rows * cell), (0, columns * cell)
    sums = np.stack(
        [
            np.histogram2d(places[:, 1], places[:, 0], (rows, columns), edges, weights=opacities * channel)[0]
            for channel in (*colours.T, np.ones(len(places)))
        ],
        axis=-1,
    )
    total = sums[..., 3:]
    full = float(np.quantile(total[total > 0], 0.7)) if total.any() else 1.0
    solid = 0.75 * np.minimum(1, total / full)
    shade = 1 - solid * (1 - sums[..., :3] / np.maximum(total, 1e-9))
    uri = _uri(Image.fromarray((255 * shade + 0.5).astype(np.uint8)))
    return f"<image width='{columns * cell:.1f}' height='{rows * cell:.1f}' href='{uri}'/>"


def _group_rings(eyes: Array, places: Array) -> Iterator[str]:
    """Yield a dashed ring around each group of cameras, where there are several."""
    groups = camera_groups(eyes)
    for number, group in enumerate(groups if len(groups) > 1 else (), 1):
        middle = places[group].mean(0)
        radius = np.linalg.norm(places[group] - middle, axis=1).max() + 24
        yield (
            f"<circle cx='{middle[0]:.1f}' cy='{middle[1]:.1f}' r='{radius:.1f}' fill='none' stroke='{_RED}' "
            f"stroke-dasharray='6 5'/><text x='{middle[0]:.1f}' y='{middle[1] - radius - 5:.1f}' "
            f"text-anchor='middle'>group {number}: {len(group)}</text>"
        )


# The graph of matches.


def _matches(matches: Matches) -> str:
    text = f"<p>{len(matches.located)} of {len(matches.names)} photographs are located.</p>"
    if matches.gaps():
        text += f"<p>To join the others (dashed), {_text(matches.advice(), 600)}.</p>"
    key = _key(_BLUE, "located") + _key(_RED, "not located")
    return _section("Which photographs match", _graph(matches), key, text)


def _graph(matches: Matches) -> str:
    """Draw photographs around a circle, in the order of their names, and lines between those that match."""
    count, middle = len(matches.names), PLOT / 2
    radius = middle - (88 if count <= NAMED else 24)
    angles = 2 * np.pi * np.arange(count) / max(count, 1) - np.pi / 2
    x, y = middle + radius * np.cos(angles), middle + radius * np.sin(angles)
    drawn = [
        f"<path d='M{x[a]:.1f} {y[a]:.1f}Q{middle} {middle} {x[b]:.1f} {y[b]:.1f}' fill='none' "
        f"stroke='#64748b' stroke-opacity='.45' stroke-width='{0.4 + 0.5 * np.log2(n / FEWEST_MATCHES):.1f}'>"
        f"<title>{_text(matches.names[a])} and {_text(matches.names[b])}: {n} matches</title></path>"
        for a, b, n in _strongest(matches)
    ]
    drawn += [
        f"<line x1='{x[a]:.1f}' y1='{y[a]:.1f}' x2='{x[b]:.1f}' y2='{y[b]:.1f}' stroke='{_RED}' "
        "stroke-width='2' stroke-dasharray='5 4'/>"
        for a, b in matches.gaps()
    ]
    for row, name in enumerate(matches.names):
        turn, left = np.degrees(angles[row]), np.cos(angles[row]) < -1e-9
        drawn.append(
            f"<g transform='translate({x[row]:.1f} {y[row]:.1f}) rotate({turn - 180 * left:.1f})'>"
            f"<title>{_text(name)}</title><circle r='4' fill='{_BLUE if row in matches.located else _RED}'/>"
        )
        if count <= NAMED:
            side = "x='-9' text-anchor='end'" if left else "x='9'"
            drawn.append(f"<text {side} y='4'>{_text(name, 15)}</text>")
        drawn.append("</g>")
    return f"<svg viewBox='0 0 {PLOT} {PLOT}' role=img>{''.join(drawn)}</svg>"


def _strongest(matches: Matches) -> list[tuple[int, int, int]]:
    """Return the pairs that join, up to `STRONGEST` for each photograph."""
    taken: dict[int, int] = {}
    found = []
    for a, b, shared in sorted(matches.pairs, key=lambda pair: -pair[2]):
        if shared >= FEWEST_MATCHES and min(taken.get(a, 0), taken.get(b, 0)) < STRONGEST:
            taken[a], taken[b] = taken.get(a, 0) + 1, taken.get(b, 0) + 1
            found.append((a, b, shared))
    return found
