"""Options that `league dash` and `league report` share."""

from dataclasses import dataclass, field

from league.commands.options import Where


@dataclass(frozen=True)
class PageOptions(Where):
    """The league, and its films."""

    films: int = field(default=3, metadata={"low": 0, "high": 4})
    """Number of films of matches, of up to 300 kB: the newest, the best-rated, the closest, the greatest upset."""
