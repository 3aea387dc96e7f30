"""`league demo`: a match of policies that come with the package. It needs no store."""

import tempfile
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, NamedTuple

from dashboards.identity import anonymous_players
from dashboards.tables import render
from league.commands.options import parse, positional
from league.commands.progress_bar import report_kernels
from league.commands.watch.view import ViewOptions, view
from league.queries.query import UnknownName
from storage.recordings.recording import Recording

if TYPE_CHECKING:
    from arenas.arena import Settings

LENGTH = 10.0
"""Length of the match to show, s: of the episodes that somebody won, the one nearest to it is taken."""


class Demo(NamedTuple):
    """A match between policies that come with the package."""

    arena: str
    sides: tuple[str, ...]  # names of policies, in the order of the arena's teams
    about: str
    episodes: int = 4  # played at once, of which one is shown


MIXED = "anymal-leatherback-sumo"
DEMOS = {
    "sumo": Demo("sumo-by-team", ("anymals-sumo", "leatherbacks-sumo"), "two ANYmals against two rovers in a ring"),
    "sumo-mixed": Demo("sumo-within-team", (MIXED, MIXED), "an ANYmal and a rover a side", 8),  # half are draws
    "push": Demo("block-push-anymal", ("anymal-push", "anymal-walk"), "two ANYmals, each pushes its block"),
    "soccer": Demo("soccer-1v1", ("anymal-soccer-preset", "leatherback-soccer-preset"), "an ANYmal against a rover"),
    "galaga": Demo("galaga-1v1", ("minitank-galaga", "crazyflie-galaga"), "a tank against a drone"),
    "galaga-2v2": Demo("galaga-2v2", ("minitanks-galaga", "crazyflies-galaga"), "two tanks against two drones"),
    "walk": Demo("anymal-walk", ("anymal-walk",), "an ANYmal walks to a point"),
    "score": Demo("soccer-score", ("anymal-score",), "an ANYmal shoots at one of two goals"),
    "fly": Demo("galaga-fly-1v1", ("crazyflie-fly",), "a drone flies to a point"),
}


@dataclass(frozen=True)
class DemoOptions(ViewOptions):
    """The demo, and the way in which it is shown or written."""

    name: str = positional("sumo")
    """A name in `league demo --list`."""
    list: bool = False
    """List the demos."""
    seed: int = field(default=1, metadata={"low": 0, "high": 2**31 - 1})
    """Seed of the match: another number shows another match."""


def demo(args: list[str]) -> int:
    """Play a match between policies that come with the package, and show it."""
    options = parse(DemoOptions, args, "demo", "A match of trained teams that come with the package; needs no store.")
    if options.list:
        print(
            render([{"demo": name, "arena": each.arena, "what it shows": each.about} for name, each in DEMOS.items()])
        )
        return 0
    if options.name not in DEMOS:
        raise UnknownName("demo", options.name, list(DEMOS))
    options.require_outputs()
    if not (options.web or options.writes):
        from dashboards import viewer

        viewer.require_display("--web for a browser on this machine, --shot match.png or --video match.webp")
    chosen = DEMOS[options.name]
    with report_kernels():
        recording = match(chosen, options.seed)
    print(f"{chosen.arena}: {recording.header.outcome}, {recording.time[-1]:.1f} s")
    view(options, recording, anonymous_players(recording.header))
    return 0


def match(chosen: Demo, seed: int) -> Recording:
    """Play a demo's match on the C engine, in a store that is removed afterwards.

    Of the episodes that somebody won it is the one whose length is nearest to `LENGTH`; if nobody won, the first.
    Equal seeds give equal matches.
    """
    from league.config.experiment import Config
    from league.matches.adhoc_matches import exhibition, pairing
    from league.queries.query import Open
    from league.runtime.bootstrap import create
    from league.snapshots import policy_file
    from storage.recordings.recording import from_bytes
    from storage.store import Store

    settings = arena_settings(chosen)
    config = Config(arena=settings, league="demo", engine="c", seed=seed)
    config = replace(config, rating=replace(config.rating, record=True, trained=False, scripts=()))
    with tempfile.TemporaryDirectory() as folder, Store.open(folder, create=True) as store:
        create(store, config, settings.build(engine="c", worlds=1))
        opened = Open(store, config.league)
        for name in chosen.sides:
            policy_file.bring_in(opened, policy_file.read(policy_file.find(name)), name)
        pair = pairing(opened, chosen.sides[0], (*chosen.sides, None)[1])
        played = exhibition(pair, chosen.episodes, chosen.episodes).matches
        recordings = [from_bytes(store.blobs.get(str(each.recording))) for each in played]
    won = [each for each in recordings if max(each.header.score) > 0.5]
    return min(won, key=lambda each: abs(each.time[-1] - LENGTH)) if won else recordings[0]


def arena_settings(chosen: Demo) -> "Settings":
    """Return the settings of a demo's arena: those in which its first policy learnt, if it learnt in this arena."""
    import arenas
    from league.config import experiment as configuration
    from league.snapshots import policy_file

    learnt = policy_file.read(policy_file.find(chosen.sides[0])).about
    if (learnt["arena"] or {}).get("arena") == chosen.arena:
        return configuration.loads(learnt["settings"]).arena
    return arenas.settings(chosen.arena)
