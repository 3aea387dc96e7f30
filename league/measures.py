"""By whom progress is told. Each measure is defined here once; the plan, the tables and the progress line use it."""

import math
from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING

from matchmaking.ladder import Ladder
from matchmaking.payoff import Score
from storage.records import Player, Snapshot

if TYPE_CHECKING:  # only their types: a query reads no configuration
    from league.config.experiment import Config
    from league.standing import Standing


def can_meet(a: Snapshot, b: Snapshot, players: Sequence[Player]) -> bool:
    """Whether two snapshots can sit on two sides of the arena, by the rosters of the teams that the players are of."""
    return (a.roster, b.roster) in _sides(tuple((p.team, p.roster) for p in players))


@cache
def _sides(teams: tuple[tuple[int, str], ...]) -> set[tuple[str, str]]:
    """The pairs of rosters that can sit on two sides: kept, for a plan asks of every pair of snapshots."""
    return {(one, other) for team, one in teams for against, other in teams if team != against}


def initial_opponents(snapshot: Snapshot, snapshots: Sequence[Snapshot], players: Sequence[Player]) -> list[Snapshot]:
    """Whom the score against initial is measured with (HARL-A's metric).

    That is the initial snapshot of its own player where the roster of another team equals its own, so that the two can
    meet; else those of all players of other teams. There are none for what belongs to no player (a script, an import),
    nor in an arena of one team, whose measure is success, nor for an initial snapshot that would meet itself.
    """
    own = next((p for p in players if p.name == snapshot.player), None)
    if own is None:
        return []
    others = [p for p in players if p.team != own.team]
    alike = any(p.roster == own.roster for p in others)
    measured = {own.name} if alike else {p.name for p in others}
    return [s for s in snapshots if s.initial and s.player in measured and s.name != snapshot.name]


def score_against_initial(
    ladder: Ladder, snapshot: Snapshot, snapshots: Sequence[Snapshot], players: Sequence[Player]
) -> Score | None:
    """The snapshot's score over all its games against its initial opponents; None where it has met none of them."""
    score = ladder.score(snapshot.name, *(s.name for s in initial_opponents(snapshot, snapshots, players)))
    return score if score.games else None


def newest_snapshots(standing: "Standing") -> list[Snapshot]:
    """Each player's newest snapshot, by iteration."""
    return [history[-1] for p in standing.players if (history := standing.history(p.name))]


def learnt_enough(config: "Config", standing: "Standing", players: Sequence[Player]) -> bool:
    """Whether these players have reached what `budget.success` or `budget.reward` asks of each of them.

    Success is that of a player's newest snapshot that was tried `rating.quota` times.
    """
    budget = config.budget
    by_success = budget.success is not None and all(
        _success(standing, player, config.rating.quota) > budget.success for player in players
    )
    by_reward = budget.reward is not None and all(
        standing.rewards.get(player.name, -math.inf) >= budget.reward for player in players
    )
    return by_success or by_reward


def _success(standing: "Standing", player: Player, quota: int) -> float:
    """The lower end of the success rate's interval; 0 where none was tried often enough."""
    tried = [s.name for s in standing.history(player.name) if standing.ladder.tried(s.name) >= quota]
    return standing.ladder.success(tried[-1]).low if tried else 0.0


def milestones(config: "Config", standing: "Standing", player: str) -> dict[str, Snapshot]:
    """A player's first snapshot after each milestone of its training time that it has passed."""
    found = {}
    for name, mark in config.milestones.items():
        late = [s for s in standing.history(player) if s.seconds >= mark and s.thinned is None]
        if late:
            found[name] = late[0]
    return found


def yardsticks(config: "Config", standing: "Standing", snapshot: Snapshot) -> list[Snapshot]:
    """By whom a newest snapshot's progress is told: initial ones, its own of the milestones, scripts, imported ones.

    Only those whom it can meet; in an arena of one team there are none.
    """
    first = initial_opponents(snapshot, standing.snapshots, standing.players)
    own = milestones(config, standing, str(snapshot.player)).values()
    wanted = config.rating.scripts
    scripts = [s for s in standing.snapshots if s.script is not None and (wanted is None or s.script in wanted)]
    imported = [s for s in standing.snapshots if s.origin == "imported"]
    found = {s.name: s for s in (*first, *own, *scripts, *imported) if can_meet(snapshot, s, standing.players)}
    return [s for s in found.values() if s.name != snapshot.name]
