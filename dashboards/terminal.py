"""Terminal output beyond text: colours, sparklines, progress bars. Pipes, files and dumb terminals get plain text."""

import os
import sys
from collections.abc import Iterable, Sequence
from itertools import cycle

BLOCKS = "▁▂▃▄▅▆▇█"
STYLES = ("bright_blue", "bright_red", "green", "yellow", "magenta", "cyan")  # the terminal's own colours
WIDTH = 8  # columns of a sparkline
BAR_WIDTH = 20  # columns of a progress bar


def supports_colour() -> bool:
    """Return whether standard output is a terminal with colours."""
    return sys.stdout.isatty() and os.environ.get("TERM", "dumb") != "dumb"


def sparkline(values: Sequence[float], low: float, high: float) -> str:
    """Return values between two bounds as at most 8 block characters, each the mean of a group of neighbours."""
    size = -(-len(values) // WIDTH) or 1
    groups = [values[i : i + size] for i in range(0, len(values), size)]
    span = max(high - low, 1e-9)
    shares = [(sum(group) / len(group) - low) / span for group in groups]
    return "".join(BLOCKS[round(min(max(share, 0.0), 1.0) * (len(BLOCKS) - 1))] for share in shares)


def progress_bar(share: float) -> str:
    """Return a completed share as a bar and a percentage."""
    share = min(max(share, 0.0), 1.0)
    full = int(share * BAR_WIDTH)
    return "━" * full + "─" * (BAR_WIDTH - full) + f" {int(100 * share)} %"


def styles(owners: Iterable[str]) -> dict[str, str]:
    """Return a colour for each owner, by its place in their order: in a league's order they are like those of films."""
    return dict(zip(dict.fromkeys(owners), cycle(STYLES), strict=False))
