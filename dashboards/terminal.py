"""What a terminal shows beside text: colours, sparklines, gauges. Pipes, files and dumb terminals get plain text."""

import os
import sys
from collections.abc import Iterable, Sequence
from itertools import cycle

BLOCKS = "▁▂▃▄▅▆▇█"
STYLES = ("bright_blue", "bright_red", "green", "yellow", "magenta", "cyan")  # in the terminal's own shades
WIDTH = 8  # columns of a sparkline
GAUGE = 20  # columns of a gauge


def is_lit() -> bool:
    """Whether what is printed goes to a terminal that knows colours."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"


def spark(values: Sequence[float], low: float, high: float) -> str:
    """Values between two bounds as a line of at most 8 blocks, each the mean of as many neighbours as it takes."""
    size = -(-len(values) // WIDTH) or 1
    groups = [values[i : i + size] for i in range(0, len(values), size)]
    span = max(high - low, 1e-9)
    shares = [(sum(group) / len(group) - low) / span for group in groups]
    return "".join(BLOCKS[round(min(max(share, 0.0), 1.0) * (len(BLOCKS) - 1))] for share in shares)


def gauge(share: float) -> str:
    """How much of something is done, as a bar and in per cent."""
    share = min(max(share, 0.0), 1.0)
    full = int(share * GAUGE)
    return "━" * full + "─" * (GAUGE - full) + f" {int(100 * share)} %"


def styles(owners: Iterable[str]) -> dict[str, str]:
    """A colour for each owner, by its place among them."""
    return dict(zip(sorted(set(owners)), cycle(STYLES), strict=False))
