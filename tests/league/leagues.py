"""Leagues for tests, as values and in a store, whose figures can be worked out by hand."""

from collections.abc import Sequence
from pathlib import Path

from storage.records import ArenaKey, Checkpoint, League, Match, Meeting, PairCounts, Player, Snapshot
from storage.store import Store

C = ArenaKey("sumo-2v2", "c0ffee00", "c")
WARP = C._replace(engine="warp")
ITERATIONS = (0, 1, 2, 4)  # at which a player is frozen

CONFIG = "[rating]\nvoid_limit = 0.05\n"


def player(name: str, team: int, roster: str = "rover", **given) -> Player:
    return Player("cup", name, team, "main", roster, **given)


BLUE, RED = player("blue", 0), player("red", 1)


def snapshot(owner: Player | None, iteration: int, digest: str = "", name: str = "", **given) -> Snapshot:
    """blue@16 and the like, after a second of training per iteration; or a script's."""
    if owner is None:
        return Snapshot("cup", name, digest or name, given.pop("roster", "rover"), script=name, origin="scripted")
    given = {"step": 100 * iteration, "seconds": float(iteration), **given}
    label = f"{owner.name}@{iteration}"
    return Snapshot(
        "cup", label, digest or label, owner.roster, owner.name, initial=iteration == 0, iteration=iteration, **given
    )


def chain(owner: Player, iterations: Sequence[int] = ITERATIONS) -> list[Snapshot]:
    """The player's snapshots, each going on from the one before."""
    names = [None, *(f"{owner.name}@{i}" for i in iterations)]
    return [snapshot(owner, i, parent=parent) for i, parent in zip(iterations, names, strict=False)]


def games(opponent: str, wins: int, losses: int, draws: int = 0, iteration: int = 1, who="blue", **more) -> Meeting:
    """What a player has learnt from against an opponent in one iteration."""
    return Meeting("cup", who, iteration, opponent, wins, draws, losses, **more)


def match(a: str, b: str | None, wins: int, losses: int, draws: int = 0, arena: ArenaKey = C, **given) -> Match:
    """A batch whose games were the same on both sides; in an arena of one team all were on the one there is."""
    counts = wins, draws, losses
    side = counts if b is None else tuple(n // 2 for n in counts)
    return Match("cup", arena, a, b, *counts, given.pop("voids", 0), *side, PairCounts(), seed=1, **given)


def filled(folder: Path, *matches: Match) -> Store:
    """A store with a league of blue and red, trained for 4 iterations, a script, and those matches."""
    store = Store.open(folder, create=True)
    store.create_league(League("cup", CONFIG))
    store.add_players([BLUE, RED])
    store.start_run("cup", CONFIG, "here", {})
    blob = store.blobs.put
    policies = [snapshot(p, i, blob(f"{p.name}@{i}".encode())) for p in (BLUE, RED) for i in (0, 1, 4)]
    store.add_snapshots([*policies, snapshot(None, 0, blob(b"pusher"), "pusher")])
    state = blob(b"state")
    finish(store, checkpoints=[Checkpoint("cup", p.name, state, 400, 4, 4000.0, C) for p in (BLUE, RED)])
    finish(store, matches=matches)
    return store


def unlike_sides(folder: Path, matches: Sequence[Match]) -> tuple[Player, Player]:
    """Fill a new store with a league of a tank against a drone: snapshots 0 and 4 of both, and these matches."""
    players = player("blue", 0, "tank:1:1"), player("red", 1, "drone:1:1")
    with Store.open(folder, create=True) as store:
        store.create_league(League("cup", ""))
        store.add_players(players)
        put = store.blobs.put
        store.add_snapshots([snapshot(p, i, put(f"{p.name}{i}".encode())) for p in players for i in (0, 4)])
        finish(store, matches=matches)
    return players


def finish(store: Store, key: str = "", **results) -> None:
    """Put results into the store as a worker would."""
    from storage.records import Job

    key = key or f"job{len(store.jobs('cup'))}"
    store.queue([Job("cup", "any", key)])
    claimed = store.claim("cup", ["any"], "somewhere:1:0", 60)
    assert claimed is not None
    store.finish(claimed[0], **results)
