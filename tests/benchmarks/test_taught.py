"""The table of taught words, on rows whose figures are known."""

from dataclasses import replace

from tests.benchmarks.taught import TaughtRow, taught_table

ROW = TaughtRow("clutter", 1, "mug", 1, True, False, True, 0.5, True, 0.8)
ROWS = [
    ROW,
    replace(ROW, found=False, right=False, iou=0.0),
    replace(ROW, alike=True, right=False, iou=0.2),
    replace(ROW, there=False, found=False, right=False, iou=0.0),
    replace(ROW, seed=2),
    replace(ROW, seed=2, there=False, right=False),
    replace(ROW, seed=2, there=False, found=False, right=False),
]


def test_shares_are_means_over_rooms_and_only_answers_that_are_accepted_can_be_wrong():
    lines = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in taught_table(ROWS).splitlines()
    ]
    assert lines[0][4:] == [
        "accepted %", "right of these %", "best region right %", "3D IoU %", "absent rejected %"
    ]  # fmt: skip
    kind, colour = lines[2:4]
    assert kind[:4] == ["clutter", "1 room", "same kind", "4"]
    assert [cell.split()[0] for cell in kind[4:]] == ["83.3", "75.0", "66.7", "56.7", "75.0"]
    assert [cell.split()[0] for cell in colour[3:]] == ["1", "100.0", "0.0", "0.0", "20.0", "75.0"]
    assert taught_table([ROW]).splitlines()[2].endswith(" - |")
