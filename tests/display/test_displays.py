"""The table of displays: channels of answers and latents, and composition on the CPU."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.config import ColourMap, Display, PictureConfig
from langsplat_core.display.composing import compose
from langsplat_core.display.displays import (
    COLOUR_MAPS,
    DISPLAYS,
    EDGE_PX,
    HEAT_BASE,
    HEAT_LIGHTNESS,
    NO_HEAT,
    NODES,
    QUERY_COLOURS,
    SEGMENT_OPACITY,
    SELECTED,
    SELECTED_OPACITY,
    STRIPE_PX,
    Channels,
    Subject,
    heats,
    mapped,
    members,
    nodes,
    painted,
)
from langsplat_core.scene import LanguageField, LinearCodec
from tests.support.file_samples import random_field
from tests.support.scenes import chain_of_levels, random_answer

PICTURE = PictureConfig()
HEAT = PictureConfig(display="relevancy", heat_opacity=1.0)
RANGES, HEATED = ((0.5, 0.9),), DISPLAYS["relevancy"]
FOUND = random_answer(360, 1)
WEAK, ABSENT = replace(FOUND, verdict="weak match"), replace(FOUND, verdict="not here")


def channels(display: Display = "rgb", value: float = 0.9, alpha: float = 1.0) -> Channels:
    """A grey image; `value` is that of the further channel."""
    count = 3 if display in ("latent", "tree") else 1
    extra = None if DISPLAYS[display].channel is None else np.full((4, 5, count), value * alpha)
    return Channels(np.full((4, 5, 3), 0.5 * alpha), np.full((4, 5), alpha), extra)


def test_displays_are_those_of_the_settings():
    assert set(DISPLAYS) == set(get_args(Display))
    assert all(name == row.name for name, row in DISPLAYS.items())
    assert len({row.label for row in DISPLAYS.values()}) == len(DISPLAYS)


@pytest.mark.parametrize(("channel", "display"), [(heats, "relevancy"), (members, "segmentation")])
def test_absent_answers_paint_nothing(channel, display):
    assert channel(Subject(360, answers=(ABSENT,))) is None
    values = channel(Subject(360, answers=(ABSENT, FOUND)))
    assert not values[:, 0].any()
    assert values[:, 1].any()
    assert DISPLAYS[display].ranges((ABSENT, FOUND, None))[0] == NO_HEAT
    assert painted((ABSENT, FOUND, None)) == {1: FOUND}


def test_a_weak_match_is_never_hotter_than_half():
    (low, high), (weak_low, weak_high) = HEATED.ranges((FOUND, WEAK))
    assert (low, high) == pytest.approx((HEAT_BASE, 1))
    assert (high - weak_low) / (weak_high - weak_low) == pytest.approx(0.5)
    assert DISPLAYS["segmentation"].ranges((FOUND, WEAK)) == ((0.0, 1.0), (0.0, 2.0))


def heat_of(values: np.ndarray, ranges) -> np.ndarray:
    ((low, high),) = ranges
    return np.clip((values[:, 0] - low) / (high - low), 0, 1)


@pytest.mark.parametrize("of", ["smooth", "own", "node"])
@pytest.mark.parametrize("scale", [None, (0.4, 0.95)])
def test_heat_is_of_the_members_by_what_is_chosen(of, scale):
    shown = {"smooth": FOUND.smooth, "own": FOUND.relevancy[2], "node": FOUND.even}[of]
    values, ranges = heats(Subject(360, answers=(FOUND,), heat=of)), HEATED.ranges((FOUND,), scale)
    low, high = scale or FOUND.heat_range
    inside = FOUND.members
    assert (values[inside] >= np.float32(HEAT_BASE)).all()
    assert not values[~inside].any()
    wanted = (np.clip(shown, *FOUND.heat_range) - low) / (high - low)
    assert_allclose(heat_of(values, ranges)[inside], np.clip(wanted, 0, 1)[inside], atol=1e-5)


@pytest.mark.parametrize(("level", "of"), [(0, "smooth"), (1, "node"), (None, "everywhere")])
def test_heat_of_a_level_and_of_everything_is_of_every_gaussian(level, of):
    values = heats(Subject(360, answers=(FOUND,), level=level, heat=of))
    low, high = FOUND.heat_range
    own = FOUND.relevancy[2 if level is None else level]
    heat = heat_of(values, HEATED.ranges((FOUND,), everywhere=True))
    assert_allclose(heat, np.clip((own - low) / (high - low), 0, 1), atol=1e-5)
    assert (values <= 0).all()  # no pixel is inside of anything


# To the cube roots of cones' answers, and from them to lightness, a and b (Ottosson 2020).
CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)


def lab_of(colour) -> np.ndarray:
    return LAB @ np.cbrt(CONES @ np.square(colour))


def shaded(lab, base) -> np.ndarray:
    """Reference in float64: (3,) a colour of OKLab with most of the lightness of `base`."""
    luminance = np.square(base) @ (0.2126, 0.7152, 0.0722)
    lab = np.array([HEAT_LIGHTNESS * lab[0] + (1 - HEAT_LIGHTNESS) * np.cbrt(luminance), *lab[1:]])
    return np.sqrt(np.clip(np.linalg.solve(CONES, np.linalg.solve(LAB, lab) ** 3), 0, 1))


BASE = np.array([0.2, 0.5, 0.7])


def patch(*values: float, **picture) -> np.ndarray:
    """Return (24, 24, 3) colours in [0, 1] of opaque pixels over `BASE`, heat in the queries' own colours."""
    shown = Channels(np.full((24, 24, 3), BASE), np.ones((24, 24)), np.full((24, 24, len(values)), values))
    return compose(shown, replace(HEAT, own_colours=True, **picture), ((0.0, 1.0),) * len(values)) / 255


def test_answers_have_their_own_colours_and_overlap_in_stripes():
    hot = [shaded(lab_of(colour), BASE) for colour in QUERY_COLOURS]
    assert_allclose(patch(1.0, 0.0)[3, 3], hot[0], atol=0.003)
    assert_allclose(patch(0.1, 1.0, 0.0)[3, 3], hot[1], atol=0.003)
    rows, columns = np.mgrid[:24, :24]
    for values in ((1.0, 1.0), (1.0, 0.0, 1.0), (1.0, 1.0, 1.0)):
        there = np.flatnonzero(values)
        stripe = there[(rows + columns) // STRIPE_PX % len(there)]
        assert_allclose(patch(*values), np.array(hot)[stripe], atol=0.003)
        flat = (1 - SEGMENT_OPACITY) * BASE + SEGMENT_OPACITY * QUERY_COLOURS[stripe]
        assert_allclose(patch(*values, display="segmentation"), flat, atol=0.003)
    half = 0.75 * hot[0] + 0.25 * PICTURE.dim * BASE
    assert_allclose(patch(0.5)[3, 3], half, atol=0.003)
    assert_allclose(patch(0.0)[3, 3], PICTURE.dim * BASE, atol=0.003)


SQUARE = np.s_[10:30, 8:22]


def framed() -> tuple[np.ndarray, np.ndarray]:
    """Return (40, 30, 1) values of a square, and (40, 30) bool its edge."""
    values, edge = np.zeros((40, 30, 1)), np.zeros((40, 30), bool)
    values[SQUARE] = edge[SQUARE] = 1
    edge[10 + EDGE_PX : 30 - EDGE_PX, 8 + EDGE_PX : 22 - EDGE_PX] = False
    return values, edge


def test_heat_keeps_the_shading_of_the_image_and_ends_in_a_line():
    grey = np.tile(np.linspace(0.2, 0.9, 40)[:, None, None], (1, 30, 3))
    values, edge = framed()
    image = compose(Channels(grey, np.ones((40, 30)), values), HEAT, ((0.0, 1.0),)) / 255
    np.testing.assert_array_equal((image == 1).all(2), edge)
    assert (np.diff(image[12:28, 15] @ (0.3, 0.6, 0.1)) > 0).all()
    hot = lab_of(mapped(np.array(1.0), HEAT.colour_map))
    assert_allclose(image[20, 15], shaded(hot, grey[20, 15]), atol=0.003)
    assert_allclose(image[5, 5], PICTURE.dim * grey[5, 5], atol=0.003)
    raw = compose(Channels(grey, np.ones((40, 30)), -values), HEAT, ((0.0, -1.0),)) / 255
    assert_allclose(raw[20, 15], image[20, 15], atol=0.003)
    assert not (raw == 1).all(2).any()  # of everything


@pytest.mark.parametrize("display", DISPLAYS)
def test_a_selection_is_outlined_and_tinted_in_every_display(display):
    selected, edge = framed()
    count = 3 if display in ("latent", "tree") else 1
    extra = None if DISPLAYS[display].channel is None else np.full((40, 30, count), 0.8)
    plain = Channels(np.full((40, 30, 3), 0.4), np.ones((40, 30)), extra)
    before, after = (
        compose(shown, replace(HEAT, display=display), RANGES) / 255
        for shown in (plain, replace(plain, selected=selected))
    )
    assert_allclose(after[edge], np.tile(SELECTED, (edge.sum(), 1)), atol=0.003)
    inside = (selected[..., 0] > 0) & ~edge
    tinted = before + SELECTED_OPACITY * (np.array(SELECTED) - before)
    assert_allclose(after[inside], tinted[inside], atol=0.005)
    np.testing.assert_array_equal(after[selected[..., 0] == 0], before[selected[..., 0] == 0])


def test_a_weak_segment_is_half_as_opaque():
    shown = Channels(np.zeros((1, 2, 3)), np.ones((1, 2)), np.array([[[1.0, 0], [0, 1.0]]]))
    got = compose(shown, PictureConfig(display="segmentation"), ((0.0, 1.0), (0.0, 2.0)))[0] / 255
    assert_allclose(got, SEGMENT_OPACITY * QUERY_COLOURS[:2] * [[1.0], [0.5]], atol=0.003)


def test_colours_lie_over_the_background():
    half = compose(channels(alpha=0.5), replace(PICTURE, background=(1.0, 1.0, 1.0)))
    assert half[0, 0].tolist() == [191, 191, 191]  # 0.25 + 0.5


def test_uncovered_pixels_are_never_relevant():
    faint, dark = (compose(channels("relevancy", value, 0.05), HEAT) for value in (1.0, 0.0))
    assert (faint == dark).all()


def test_heat_spans_its_range():
    below = compose(channels("relevancy", 0.49), HEAT, RANGES)
    coldest = shaded(lab_of(COLOUR_MAPS[HEAT.colour_map][0] / 255), [0.5] * 3)
    assert_allclose(below[0, 0] / 255, coldest, atol=0.003)
    hottest = shaded(lab_of(COLOUR_MAPS[HEAT.colour_map][255] / 255), [0.5] * 3)
    assert_allclose(compose(channels("relevancy", 0.9), HEAT, RANGES)[0, 0] / 255, hottest, atol=0.003)
    for value in (0.0, 0.3, 1.0):  # without a range it is hot over all of 0 to 1
        shown = channels("relevancy", value)
        assert (compose(shown, HEAT) == compose(shown, HEAT, ((0.0, 1.0),))).all()


@pytest.mark.parametrize("name", ["inferno", "viridis", "cividis", "magma"])
def test_published_colour_maps_are_as_published(name):
    colormaps = pytest.importorskip("matplotlib").colormaps
    expected = np.rint(255 * colormaps[name](np.arange(256))[:, :3])
    np.testing.assert_array_equal(COLOUR_MAPS[name], expected)


def test_every_colour_map_that_can_be_chosen_has_a_table():
    assert tuple(COLOUR_MAPS) == get_args(ColourMap)
    assert all(table.shape == (NODES, 3) and table.dtype == np.uint8 for table in COLOUR_MAPS.values())
    assert mapped(np.array(0.25), "grey").tolist() == pytest.approx([0.25] * 3)
    assert mapped(np.array(2.0), "magma").tolist() == (COLOUR_MAPS["magma"][-1] / 255).tolist()


@pytest.mark.parametrize("name", ["inferno", "viridis", "amber", "cividis", "magma", "grey"])
def test_colour_maps_for_the_colour_blind_brighten(name):
    luminance = COLOUR_MAPS[name] / 255.0 @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(luminance[::8]) > 0).all()


@pytest.mark.parametrize("display", DISPLAYS)
def test_transparent_images_over_a_background_are_opaque_ones(display):
    """PNG's colours, not premultiplied: over a background they are what is drawn, of rgb and latent."""
    picture = replace(PICTURE, display=display, background=(0.2, 0.5, 0.9))
    for alpha in (0.0, 0.2, 0.6, 1.0):
        shown = channels(display, alpha=alpha)
        clear = compose(shown, replace(picture, transparent=True), RANGES) / 255
        assert clear.shape == (4, 5, 4)
        share = clear[..., 3:]
        over = clear[..., :3] * share + (1 - share) * picture.background
        if display in ("rgb", "latent", "tree", "depth", "alpha") or alpha == 1:
            np.testing.assert_allclose(over, compose(shown, picture, RANGES) / 255, atol=0.01)
        if display not in ("alpha", "depth"):
            np.testing.assert_allclose(share, alpha, atol=0.003)


def test_missing_channels_show_plain_colours():
    for display in (row.name for row in DISPLAYS.values() if row.channel is not None):
        assert (compose(channels(), replace(PICTURE, display=display)) == 128).all()


@pytest.mark.parametrize("d", [1, 2, 3, 8])
def test_latent_colours_for_any_dimension(d):
    rng = np.random.default_rng(d)
    codec = LinearCodec(np.eye(12, dtype=np.float32)[:d])
    latents = rng.normal(size=(3, 50, d)).astype(np.float32)
    confidence = np.ones((3, 50), np.float32)
    confidence[:, 10] = 0
    field = LanguageField(latents, confidence, codec, np.eye(12, dtype=np.float32)[:4], "none")
    colours = field.colours
    assert colours.shape == (3, 50, 3)
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert (colours[:, 10] == 0.5).all()
    assert np.ptp(colours[:, :10]) > 0.5


def test_nodes_have_their_own_colours_and_others_are_grey():
    field = random_field(6)
    assert nodes(Subject(6, field, level=0)) is None  # keeps no tree
    tree = chain_of_levels(np.array([0, 1, 1, -1, 2, 0], np.int32))
    colours = nodes(Subject(6, replace(field, tree=tree), level=1))
    assert (colours.shape, colours.dtype) == ((6, 3), np.float32)
    assert colours[3].tolist() == [0.5] * 3
    assert ((colours >= 0) & (colours <= 1)).all()
    same = (colours[:, None] == colours[None]).all(-1)
    assert (same == (tree.leaves[:, None] == tree.leaves[None])).all()
