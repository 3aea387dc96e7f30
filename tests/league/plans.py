"""Leagues for tests of the plan: what a store would hold, as values."""

from dataclasses import replace

from league.config import presets
from league.config.sections import Budget
from league.scheduling import turn_scheduler
from league.state.jobs import TrainingTurn, decode
from league.state.league_state import LeagueState
from matchmaking.ratings.ladder import Ladder
from storage.records import ArenaKey, Checkpoint, Match, PairCounts, Player, Snapshot

KEY = ArenaKey("sumo-2v2", "0", "c")
PLAYERS = tuple(Player("quickstart", name, team, "main", "rover") for team, name in enumerate(("blue", "red")))
MORE = (*PLAYERS, *(replace(p, name=f"{p.name}-2", group="2") for p in PLAYERS))


def checkpoints(iteration, seconds=0.0, players=PLAYERS):
    if isinstance(iteration, int):
        iteration = {p.name: iteration for p in players}
    return {name: Checkpoint("quickstart", name, f"{name}:{i}", i * 8192, i, seconds) for name, i in iteration.items()}


def snapshots(*iterations: int, seconds: float = 1.0, players=PLAYERS) -> tuple[Snapshot, ...]:
    frozen = tuple(
        Snapshot(
            "quickstart", f"{p.name}@{i}", f"digest of {p.name}@{i}", p.roster, p.name, initial=i == 0, step=i * 8192,
            iteration=i, seconds=i * seconds,
        )
        for i in iterations
        for p in players
    )  # fmt: skip
    return (Snapshot("quickstart", "pusher", "p", "rover", script="pusher", origin="scripted"), *frozen)


def league_state(matches=(), **given) -> LeagueState:
    empty = {"players": PLAYERS, "snapshots": (), "checkpoints": {}, "phases": {}, "jobs": ()}
    values = {**empty, **given}
    names = [s.name for s in values["snapshots"]]
    played = max((m.created for m in matches), default=0.0)
    ladder = Ladder(names, matches, [s.name for s in values["snapshots"] if s.initial])
    return LeagueState(**values, ladder=ladder, played=played)


def match(a: str, b: str | None, games: int = 128) -> Match:
    half = games // 2
    pairs = PairCounts(0, 0, half, 0, 0) if b else PairCounts()
    return Match("quickstart", KEY, a, b, half, 0, half, 0, half // 2, 0, half // 2, pairs, 1)


def training(**changes):
    base = replace(presets.preset("quickstart"), budget=Budget("5m", rating_time="3m"))
    return replace(base, training=replace(base.training, worlds=256, **changes))


def turns(config, state) -> list[TrainingTurn]:
    return [decode(job) for job in turn_scheduler.next_turns(config, state).jobs]


def pairs_of(planned) -> list[tuple]:
    return [pair for job in planned.jobs for pair in decode(job).lineups]


def with_matches(state: LeagueState, played) -> LeagueState:
    """The same league once these matches, and no others, have been played."""
    names = [s.name for s in state.snapshots]
    return replace(state, ladder=Ladder(names, tuple(played), [s.name for s in state.snapshots if s.initial]))
