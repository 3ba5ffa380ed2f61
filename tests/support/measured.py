"""What accuracy tests measured, beside their verdict: kept as properties of the test and printed as a table
with `--slow` or `--measured`."""

from collections.abc import Callable

import pytest

_ROWS = pytest.StashKey[dict[tuple[str, str], list[float]]]()
Measure = Callable[[str, str, float], None]


@pytest.fixture
def measured(request: pytest.FixtureRequest, record_property: Callable[[str, object], None]) -> Measure:
    """measured(group, quantity, value): remember one figure; the table shows count, largest and sum."""

    def remember(group: str, quantity: str, value: float) -> None:
        record_property(f"{group}: {quantity}", value)
        request.config.stash.setdefault(_ROWS, {}).setdefault((group, quantity), []).append(float(value))

    return remember


def print_measured(reporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """The table of everything remembered in this run."""
    rows = config.stash.get(_ROWS, {})
    if not rows:
        return
    reporter.write_sep("-", "measured")
    reporter.write_line(f"{'':<58} {'count':>6} {'largest':>10} {'sum':>10}")
    for (group, quantity), values in sorted(rows.items()):
        label = f"{group}: {quantity}"
        reporter.write_line(f"{label:<58} {len(values):>6} {max(values):>10.3g} {sum(values):>10.4g}")
