"""`league grid`: play snapshots over a grid of what an arena's designer may set, such as masses and friction."""

from dataclasses import dataclass, field
from typing import Any

from dashboards.tables import Column, render
from league.commands.options import Listing, parse, positional, without_settings
from league.commands.progress_bar import report_kernels
from league.config import experiment as configuration
from league.config.schema import ConfigError

WHAT = """Play snapshots over a grid of what an arena's designer may set, such as masses and friction: mean, worst tenth
and worst cell of score and return. Flags such as --arena.design change the arena; nothing is kept."""
MOST = 2**17
COLUMNS = (
    Column("snapshot", no_wrap=True), Column("score", decimals=3), Column("score_tenth", "worst tenth", 3),
    Column("score_worst", "worst", 3), Column("return", decimals=2), Column("return_tenth", "worst tenth", 2),
    Column("return_worst", "worst", 2), Column("where", "worst cell"), "voids",
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class GridOptions(Listing):
    """The snapshots, and the size of the grid."""

    snapshots: tuple[str, ...] = positional(many=True)
    """Snapshots such as blue@64, or players, whose newest counts: `league snapshots` lists them."""
    points: int = field(default=10, metadata={"low": 1, "high": 1000})
    """Values of each number that the designer sets, from its lowest to its highest; of a choice all."""
    episodes: int = field(default=10, metadata={"low": 1, "high": 2**16})
    """Episodes in each cell; all cells have the same seeds."""
    seed: int = field(default=1, metadata={"low": 0})
    """Seed of the starts and of the policies' draws."""


def grid(args: list[str]) -> int:
    """Play, and print a row per snapshot; as JSON or CSV a row per cell."""
    own, given = without_settings(args, "arena")
    options = parse(GridOptions, own, "grid", WHAT)
    if not options.snapshots:
        raise ConfigError((), "league grid needs SNAPSHOTS: see league grid --help")
    from league.matches.design_grid import designer_of, grid_points, play_grid

    with options.open() as opened:
        config = configuration.change(configuration.loads(opened.store.league(opened.league).config), given)
        snapshots = [opened.snapshot(name) for name in options.snapshots]
        probe = config.arena.build(engine="c")
        cells = len(grid_points(probe.robots[designer_of(probe)].sets, options.points))
        worlds = cells * options.episodes
        if worlds > MOST:
            raise ConfigError((), f"{worlds:,} episodes at once are more than {MOST:,}: fewer --points or --episodes")
        with report_kernels():
            where = {"engine": config.engine, "threads": config.workers.threads, **config.buffers.where()}
            arena = config.arena.build(worlds=worlds, **where)
            grids = [
                play_grid(arena, opened.store, each, options.points, options.episodes, options.seed)
                for each in snapshots
            ]
    names = [snapshot.name for snapshot in snapshots]
    if options.format != "table":
        rows = [row for name, found in zip(names, grids, strict=True) for row in _cells(name, found)]
        print(render(rows, format=options.format))
        return 0
    title = f"{worlds:,} episodes: {cells:,} cells of {', '.join(grids[0].names)}, {options.episodes} each"
    print(render([_row(name, found) for name, found in zip(names, grids, strict=True)], COLUMNS, title=title))
    return 0


def _row(name: str, found: Any) -> dict[str, Any]:
    from league.matches.design_grid import summarise

    score, total = summarise(found.scores, found.labels), summarise(found.returns, found.labels)
    where = ", ".join(f"{n} {x if isinstance(x, str) else format(x, '.3g')}" for n, x in total.where.items())
    return {
        "snapshot": name, "score": score.mean, "score_tenth": score.tenth, "score_worst": score.least,
        "return": total.mean, "return_tenth": total.tenth, "return_worst": total.least, "where": where,
        "voids": found.voids,
    }  # fmt: skip


def _cells(name: str, found: Any) -> list[dict[str, Any]]:
    return [
        {"snapshot": name, **labels, "score": score, "return": total}
        for labels, score, total in zip(found.labels, found.scores.tolist(), found.returns.tolist(), strict=True)
    ]
