"""What accuracy tests measured, beside their verdict: kept as properties of the test and printed as a table
with `--slow` or `--measured`."""

from collections.abc import Callable
from itertools import chain

import pytest

Measure = Callable[[str, str, float], None]


@pytest.fixture
def measured(record_property: Callable[[str, object], None]) -> Measure:
    """measured(group, quantity, value): remember one figure; the table shows count, largest and sum."""

    def remember(group: str, quantity: str, value: float) -> None:
        record_property(f"{group}: {quantity}", float(value))

    return remember


def print_measured(reporter: pytest.TerminalReporter) -> None:
    """The table of everything remembered in this run, by whichever worker."""
    rows: dict[str, list[float]] = {}
    for report in chain.from_iterable(reporter.stats.values()):
        if getattr(report, "when", "") == "call":
            for label, value in report.user_properties:
                rows.setdefault(label, []).append(value)
    if not rows:
        return
    reporter.write_sep("-", "measured")
    reporter.write_line(f"{'':<58} {'count':>6} {'largest':>10} {'sum':>10}")
    for label, values in sorted(rows.items()):
        reporter.write_line(f"{label:<58} {len(values):>6} {max(values):>10.3g} {sum(values):>10.4g}")
