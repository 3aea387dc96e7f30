"""Opponents that measure progress. The plan, the tables and the progress line share these definitions."""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

from matchmaking.match_design import HISTORY_OFFSETS, RequiredOpponents, others_after
from matchmaking.ratings.ladder import Ladder
from matchmaking.ratings.scores import Score
from storage.records import Player, Snapshot

if TYPE_CHECKING:  # for their types only: a query does not import the configuration
    from league.config.experiment import Config
    from league.state.league_state import LeagueState


def can_meet(a: Snapshot, b: Snapshot, players: Iterable[Player]) -> bool:
    """Return whether two snapshots can play on two sides of the arena, by the rosters of the players' teams."""
    return (a.roster, b.roster) in meeting_rosters(players)


def meeting_rosters(players: Iterable[Player]) -> set[tuple[str, str]]:
    """Return the pairs of rosters that can play on two sides of the arena."""
    teams = {(p.team, p.roster) for p in players}
    return {(one, other) for team, one in teams for against, other in teams if team != against}


def initial_opponents(snapshot: Snapshot, snapshots: Sequence[Snapshot], players: Sequence[Player]) -> list[Snapshot]:
    """Return the opponents of a snapshot for its score against initial (HARL-A's metric).

    This is the initial snapshot of its own player if another team has the same roster, so that the two can meet; else
    the initial snapshots of all players of other teams. The list is empty for a snapshot of no player (a script, an
    import), in an arena of one team, which is measured by success, and for an initial snapshot that would meet itself.
    """
    own = next((p for p in players if p.name == snapshot.player), None)
    if own is None:
        return []
    others = [p for p in players if p.team != own.team]
    alike = any(p.roster == own.roster for p in others)
    measured = {own.name} if alike else {p.name for p in others}
    return [s for s in snapshots if s.initial and s.player in measured and s.name != snapshot.name]


def budget_opponents(against: Sequence[str], state: "LeagueState", snapshot: Snapshot) -> list[Snapshot]:
    """Return the opponents of a snapshot for the score that ends training.

    These are the scripts `against` (the setting `budget.against`) that it can meet; without that setting its initial
    opponents.
    """
    if not against:
        return initial_opponents(snapshot, state.initials, state.players)
    return [s for s in state.snapshots if s.script in against and can_meet(snapshot, s, state.players)]


def score_against_initial(
    ladder: Ladder, snapshot: Snapshot, snapshots: Sequence[Snapshot], players: Sequence[Player]
) -> Score | None:
    """Return a snapshot's score over all its games against its initial opponents; None if it has met none of them."""
    score = ladder.score(snapshot.name, *(s.name for s in initial_opponents(snapshot, snapshots, players)))
    return score if score.games else None


def milestones(config: "Config", state: "LeagueState", player: str) -> dict[str, Snapshot]:
    """Return a player's first snapshot after each milestone of training time that it has passed, by milestone."""
    found = {}
    for name, mark in config.milestones.items():
        late = [s for s in state.history(player) if s.seconds >= mark and s.thinned is None]
        if late:
            found[name] = late[0]
    return found


def reference_opponents(config: "Config", state: "LeagueState", snapshot: Snapshot) -> list[Snapshot]:
    """Return the opponents that measure a newest snapshot: initial ones, its milestones, scripts, imported policies.

    Only opponents that it can meet; none in an arena of one team.
    """
    first = initial_opponents(snapshot, state.initials, state.players)
    own = milestones(config, state, str(snapshot.player)).values()
    others = (*first, *own, *_anchors(config, state))
    found = {s.name: s for s in others if can_meet(snapshot, s, state.players)}
    return [s for s in found.values() if s.name != snapshot.name]


def _anchors(config: "Config", state: "LeagueState") -> list[Snapshot]:
    """Return the opponents that never learn: the scripts named by the settings, and imported policies."""
    wanted = config.rating.scripts
    scripts = [s for s in state.snapshots if s.script is not None and (wanted is None or s.script in wanted)]
    return [*scripts, *(s for s in state.snapshots if s.origin == "imported")]


def parent(snapshot: Snapshot, history: Sequence[Snapshot], by_name: Mapping[str, Snapshot]) -> list[Snapshot]:
    """Return the parent of a player's newest snapshot, else the last snapshot before it; empty for the first.

    Only snapshots that still have their policy: `history` is the list of these for the player, oldest first.
    """
    before = [s for s in history if s.name != snapshot.name][-1:]
    known = by_name.get(snapshot.parent or "")
    return [known] if known is not None and known.thinned is None else before


def required_opponents(config: "Config", state: "LeagueState", over: bool) -> dict[str, RequiredOpponents]:
    """Return the opponents that each player's newest snapshot meets first, see matchmaking.match_design.

    These are the newest snapshots of all other players; then the opponents that decide when training ends, its initial
    ones, its own snapshot 3 back, its parent, its own 10 back; then scripts and imports, and after training (`over`)
    the milestones too. Only snapshots that it can meet and that still have their policy.
    """
    newest = [s for s in state.newest_snapshots if s.thinned is None]
    of, names, found = {s.name: s for s in newest}, [s.name for s in newest], {}
    sides, never_learn = meeting_rosters(state.players), _anchors(config, state)
    for s in newest:
        history = [each for each in state.history(str(s.player)) if each.thinned is None]
        past = [history[-1 - back] for back in HISTORY_OFFSETS if len(history) > back]
        first = [
            *budget_opponents(config.budget.against, state, s),
            *initial_opponents(s, state.initials, state.players),
        ]
        measures = [*first, *past[:1], *parent(s, history, state.by_name), *past[1:]]
        anchors = reference_opponents(config, state, s) if over else never_learn
        rivals = [of[name] for name in others_after(names, s.name)]
        found[s.name] = RequiredOpponents(*(
            [o.name for o in others if o.thinned is None and o.name != s.name and (s.roster, o.roster) in sides]
            for others in (rivals, measures, anchors)
        ))  # fmt: skip
    return found
