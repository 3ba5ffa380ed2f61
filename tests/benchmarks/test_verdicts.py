"""Verdicts and their calibration, on margins whose truth is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.errors import InputError
from langsplat_core.scene import Calibration, Odds
from tests.benchmarks import verdicts as module
from tests.benchmarks.__main__ import parse
from tests.benchmarks.room import InRooms
from tests.benchmarks.verdicts import (
    PAIRS,
    REJECTED,
    Verdict,
    curve,
    curve_table,
    fit_calibration,
    fit_odds,
    verdict_table,
    write_calibration,
)

TRUE = Odds(-1.0, 18.0, 6.0)


def logistic(count: int, seed: int = 0) -> tuple[Array, Array]:
    """Fits of things that are there and that are not, by `TRUE`: about as many of both."""
    rng = np.random.default_rng(seed)
    margins = rng.uniform([-0.3, -0.3, -0.25], [0.3, 0.1, 0.3], (count, 3))
    likely = np.array([TRUE.probability(tuple(row)) for row in margins.tolist()])
    there = rng.uniform(size=count) < likely
    return margins[there], margins[~there]


def test_a_fit_recovers_what_made_the_data():
    present, absent = logistic(20_000)
    fitted = fit_odds(present, absent)
    assert fitted.whole == pytest.approx(TRUE.whole, rel=0.06)
    assert fitted.finer == pytest.approx(TRUE.finer, rel=0.12)
    # Both weigh the same in the fit: the constant moves by the logarithm of how many there are of each.
    want = TRUE.constant - np.log(len(present) / len(absent))
    assert fitted.constant == pytest.approx(want, abs=0.12)


def test_how_many_there_are_of_each_changes_nothing():
    present, absent = logistic(4_000)
    once, often = fit_odds(present, absent), fit_odds(present, np.tile(absent, (9, 1)))
    for name in ("constant", "whole", "finer", "found"):
        assert getattr(often, name) == pytest.approx(getattr(once, name), rel=0.02, abs=0.02)


def test_found_rejects_as_much_of_what_is_absent_as_is_asked():
    present, absent = logistic(3_000)
    fitted = fit_odds(present, absent)
    said = np.array([fitted.probability(tuple(row)) for row in absent.tolist()])
    assert REJECTED <= (said < fitted.found).mean() < REJECTED + 0.01
    apart = fit_odds(np.full((20, 3), 0.5), np.full((20, 3), -0.5))
    assert apart.found == 0.5  # never less than even
    assert np.isfinite([apart.constant, apart.whole, apart.finer]).all()  # Platt's targets keep it so


def test_nothing_to_fit_to():
    for few, others in ((9, 100), (100, 9)):
        with pytest.raises(InputError, match="ten things that are there"):
            fit_odds(np.zeros((few, 3)), np.zeros((others, 3)))
    with pytest.raises(InputError, match="ten things"):
        fit_calibration([])
    present, absent = logistic(500)
    with pytest.raises(InputError, match="nothing to calibrate"):
        fit_odds(absent, present)


def test_every_way_of_looking_has_its_own_odds():
    spread = {"thing": 1.0, "part": 0.5, "inside": 0.25}
    rows = []
    for name, factor in spread.items():
        for kind, margins in zip(PAIRS[name], logistic(4_000), strict=True):
            rows += [
                Verdict("clutter", 1, "x", kind, tuple(m), None, False) for m in (factor * margins).tolist()
            ]
    fitted = fit_calibration(rows)
    assert fitted.part.whole == pytest.approx(2 * fitted.thing.whole, rel=0.02)
    assert fitted.inside.finer == pytest.approx(4 * fitted.thing.finer, rel=0.02)


def test_writing_keeps_what_else_stands_there(tmp_path):
    path = tmp_path / "reading.json"
    calibration = Calibration(TRUE, Odds(0, 0, 1), replace(TRUE, found=0.8))
    write_calibration(path, calibration)
    assert json.loads(path.read_text())["calibration"]["part"] == {
        "constant": 0, "whole": 0, "finer": 1, "found": 0.75
    }  # fmt: skip
    path.write_text('{"found": 0.73, "calibration": {"constant": 9}}')
    write_calibration(path, calibration)
    stated = json.loads(path.read_text())
    odds = {name: Odds(**numbers) for name, numbers in stated["calibration"].items()}
    assert (stated["found"], Calibration(**odds)) == (0.73, calibration)
    assert list(tmp_path.iterdir()) == [path]


def row(kind: str, probability: float | None, *, found: bool | None = None, seed: int = 1, tier="clutter"):
    margin = 0.1 if probability is None else probability
    said = (probability or 0) >= 0.75 if found is None else found
    return Verdict(tier, seed, "a thing", kind, (margin, -0.1, margin), probability, said)


ROOM = [row("object", p) for p in (0.2, 0.8, 0.9, 0.95)] + [row("colour+object", p) for p in (0.7, 0.99)]
ROOM += [row("absent", p) for p in (0.01, 0.02, 0.5, 0.76)]


def cells(table: str, line: int) -> list[str]:
    return [cell.strip() for cell in table.splitlines()[line].strip("|").split("|")]


def test_the_table_has_a_line_for_every_way_of_asking_and_means_over_rooms():
    parts = [row("part", 0.9), row("part", 0.3), row("absent part", 0.1)]
    inside = [row("part of thing", 0.9), row("absent part of thing", 0.8)]
    table = verdict_table(ROOM + parts + inside)
    assert [cells(table, n)[1] for n in range(2, 6)] == ["thing", "colour + thing", "part", "inside"]
    tier, _, phrases, accepted, rejected, area, *at = cells(table, 2)
    assert (tier, phrases, accepted, rejected) == ("clutter", "8", "75.0 +/- 0.0", "75.0 +/- 0.0")
    pairs = [a > b for a in (0.2, 0.8, 0.9, 0.95) for b in (0.01, 0.02, 0.5, 0.76)]
    assert area == f"{100 * np.mean(pairs):.1f} +/- 0.0"
    assert at == ["75.0 +/- 0.0"] * 3  # of four absent things none but the best is the limit
    assert cells(table, 4)[2:5] == ["3", "50.0 +/- 0.0", "100.0 +/- 0.0"]
    assert cells(table, 5)[2:5] == ["2", "100.0 +/- 0.0", "0.0 +/- 0.0"]
    other = [replace(r, seed=2, found=True) for r in ROOM]
    third = [replace(r, tier="separate", probability=None) for r in ROOM]
    table = verdict_table(ROOM + other + third)
    assert cells(table, 2)[3] == f"87.5 +/- {100 * np.std([0.75, 1], ddof=1):.1f}"
    assert [cells(table, n)[0] for n in range(2, 6)] == ["clutter", "clutter", "separate", "separate"]
    assert cells(table, 4)[1:] == cells(verdict_table(ROOM), 2)[1:]  # the best margin takes its place


def test_a_room_without_one_kind_of_phrase_is_no_error():
    half = [r for r in ROOM if r.kind != "colour+object"] + [replace(r, seed=2) for r in ROOM]
    assert cells(verdict_table(half), 3)[3] == "50.0 +/- 0.0"  # of the rooms that have such things
    assert cells(verdict_table([row("object", 0.9)]), 2)[3:] == ["100.0 +/- 0.0", *["-"] * 5]
    assert verdict_table([row("absent", 0.1)]).count("\n") == 2


def test_the_curve_weighs_present_and_absent_alike():
    points = curve(ROOM)
    assert [(p.low, p.high) for p in points] == [(0, 0.1), (0.1, 0.25), (0.5, 0.75), (0.75, 0.9), (0.9, 1)]
    assert [p.phrases for p in points] == [2, 1, 1, 2, 2]  # coloured things are not counted
    assert [p.said for p in points] == pytest.approx([0.015, 0.2, 0.5, 0.78, 0.925])
    assert [p.there for p in points] == pytest.approx([0, 1, 0, 0.5, 1])
    uneven = curve(ROOM + [row("absent", p) for p in (0.01, 0.02, 0.5, 0.76)] * 9)
    assert [p.phrases for p in uneven] == [20, 1, 10, 11, 2]
    assert [p.said for p in uneven] == pytest.approx([p.said for p in points])
    assert [p.there for p in uneven] == pytest.approx([p.there for p in points])
    assert cells(curve_table(ROOM), 5) == ["0.75 to 0.9", "2", "78", "50"]
    certain = curve([row("object", 1.0), row("absent", 0.0)])
    assert [(p.low, p.there) for p in certain] == [(0, 0), (0.9, 1)]
    assert curve([row("object", None)]) == []


def calibration_data(*_: object) -> list[Verdict]:
    present, absent = logistic(300)
    rows = [(there, margins) for there, _ in PAIRS.values() for margins in present]
    rows += [(missing, margins) for _, missing in PAIRS.values() for margins in absent]
    rows += [("colour+object", margins) for margins in present]
    return [
        Verdict("clutter", 301, "x", kind, tuple(m.tolist()), float(sigmoid(20 * m[2])), bool(m[2] > 0.1))
        for kind, m in rows
    ]


def test_the_command_writes_tables_and_a_calibration(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(InRooms, "rooms", lambda *_: ["a room"])
    monkeypatch.setattr(module, "measure_verdicts", calibration_data)
    command = parse(["verdicts", "--seeds", "301", "--out", str(tmp_path / "out")])
    command.run()
    printed = capsys.readouterr().out
    stored = json.loads((tmp_path / "out" / "verdicts.json").read_text())
    assert stored["settings"]["seeds"] == [301]
    assert len(stored["rows"]) == len(calibration_data())
    assert "absent rejected %" in printed
    assert verdict_table(calibration_data()) in (tmp_path / "out" / "verdicts.md").read_text()
    assert not (tmp_path / "reading.json").exists()
    replace(command, fit=tmp_path / "reading.json").run()
    stated = json.loads((tmp_path / "reading.json").read_text())["calibration"]
    assert all(10 < Odds(**stated[name]).whole < 30 for name in PAIRS)
    assert "reading.json: Calibration(" in capsys.readouterr().out
