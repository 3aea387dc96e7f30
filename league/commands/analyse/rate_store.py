"""`league rate --store STORE`: play rating matches of what a store holds, without training."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from league.commands.ladder_text import ratings_table
from league.commands.progress_bar import Progress, report_kernels
from league.config import experiment as configuration
from league.config.durations import seconds
from league.config.schema import ConfigError
from league.queries.query import Open
from league.system.arena_build import build, rating_batch
from storage.records import Snapshot

if TYPE_CHECKING:
    from league.matches.store_rating import Done


def rate_store(opened: Open, among: Sequence[str], budget: str, episodes: int | None, width: float | None) -> int:
    """Play until a limit is reached, and print the ratings. Raises ConfigError if there is nothing to rate."""
    from league.matches.evaluator import MatchEvaluator
    from league.matches.store_rating import Limits, chosen, rate

    store, league = opened.store, opened.league
    players, snapshots = store.players(league), chosen(opened, among)
    if not players:
        raise ConfigError((), f"league {league} has no players, and so no teams that could play")
    if width is not None and len({p.team for p in players}) == 1:
        raise ConfigError(
            ("width",), f"--width is in Elo, and league {league} has one team, which has none: give --episodes"
        )
    config = configuration.loads(store.league(league).config)
    evaluator = MatchEvaluator(config, build(config, rating_batch(config).worlds, players), league)
    limits, done = Limits(seconds(budget), episodes, width), None
    with report_kernels(), Progress("rating") as progress:
        for done in rate(opened, config, evaluator, snapshots, limits):
            widest = "" if done.widest is None else f"widest interval {done.widest:.0f} Elo, "
            progress.tell(f"{widest}episodes", done.episodes, episodes)
    assert done is not None
    if not done.episodes and done.ladder.arena is None:
        raise ConfigError(
            (), f"none of the snapshots of league {league} can meet another: `league snapshots` lists them"
        )
    shown = [s for s in store.snapshots(league, brief=True) if not among or s.name in {each.name for each in snapshots}]
    print(ratings_table(done.ladder, shown, players, opened.void_limit()))
    print(f"\nPlayed {done.episodes:,} episodes{'' if done.ladder.one_team else f'; {least_sure(done, snapshots)}'}.")
    if done.repetition:
        print(done.repetition)
    return 0


def least_sure(done: "Done", snapshots: Sequence[Snapshot]) -> str:
    """Describe the widest interval, or name a rating that is not known yet."""
    if done.widest is not None:
        return f"the widest interval is ±{done.widest / 2:.0f} Elo"
    unknown = [s.name for s in snapshots if s.name not in done.ladder.anchors and not done.ladder.known(s.name)]
    more = f" and {len(unknown) - 1} more" if len(unknown) > 1 else ""
    return f"the rating of {unknown[0]}{more} is not known yet"
