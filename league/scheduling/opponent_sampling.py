"""Opponent sampling: the distribution over a learner's opponents in its next turn, and the reason for it.

The turn scheduler draws from this distribution and `league explain` prints it. It follows from the store alone. Win
rates and qualities come from the games that the player has learnt from (`storage.records.Meeting`, written in the
transaction that ends a turn); predicted scores and payoffs come from rating matches. No state is kept between turns,
so a restart changes nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from league.scheduling.game_folds import Part, quality_scores, win_records
from league.state.league_state import LeagueState
from matchmaking.metagame.alpharank import alpharank, nash
from matchmaking.opponents import (
    Mixture,
    Opponents,
    WinRecords,
    alphastar,
    by_quality,
    delta_uniform,
    draw,
    exploit,
    gaussian,
    latest,
    pfsp,
    uniform,
)
from matchmaking.ratings.scores import Score, score_interval
from matchmaking.roles import LEAGUE_EXPLOITER, MAIN, Role, is_exploiter
from storage.records import Player, Snapshot

WIN_RATE = "win rate"


@dataclass(frozen=True, eq=False)
class OpponentDistribution:
    """Distribution over a learner's opponents in one other team, for its groups of worlds that the rule fills.

    `mixture.past` is over `names`; without any names, the opponent is the present player.
    """

    opponent: str  # the player of that team with its present policy, "" without one
    names: tuple[str, ...]  # (n,) of snapshots, oldest first
    mixture: Mixture
    read: np.ndarray | None = None  # (n,) input of the rule: win rates, predicted scores, qualities or payoffs
    quantity: str = ""  # the name of that input

    def draw(self, groups: Sequence[str]) -> list[tuple[str, float]]:
        """Return for each group of worlds a snapshot, "" for the present player, and its probability.

        A group is a text that stays while it should keep its opponent.
        """
        names, weights = (*self.names, ""), self.mixture.weights
        return [(names[i], float(weights[i])) for i in draw(weights, names, groups)]


def opponent_distribution(
    opponents: Opponents, state: LeagueState, learner: Player, team: int, opponent: str, role: Role = MAIN,
    since: int = -1,
) -> OpponentDistribution:  # fmt: skip
    """Compute the distribution over a learning player's opponents in another team.

    Args:
        opponents: the rule.
        state: the state of the league.
        learner: the player.
        team: the other team.
        opponent: the present player of that team, "" for none.
        role: the learner's role, which determines the players whose snapshots it meets.
        since: the iteration of the learner's last reset; only games after it count. -1 without a reset.
    """
    pool = met_in(role, opponents, state, team)
    names = tuple(s.name for s in pool)
    n, read, quantity = len(names), None, ""
    if not names:
        return OpponentDistribution(opponent, (), Mixture(1.0, np.zeros(0), "there is no such snapshot"))
    match opponents.kind:
        case "latest":
            past, why = latest(n), "the newest snapshot"
        case "uniform":
            past, why = uniform(n), "every snapshot alike"
        case "delta_uniform":
            past, why = delta_uniform(n, opponents.delta), f"every snapshot alike but the oldest {opponents.delta:.0%}"
        case "pfsp":
            read, quantity = records(opponents, state, learner, since).rates(names), WIN_RATE
            past, why = pfsp(read, opponents.weighting), f"by win rate, weighting {opponents.weighting}"
        case "openai_five":
            ever = [s.name for s in _ever_met_in(role, state, team)]
            of_all = dict(zip(ever, qualities(opponents, state, learner, ever, since).tolist(), strict=True))
            read, quantity = np.array([of_all[name] for name in names]), "quality"
            past, why = by_quality(read), f"softmax of qualities, learning rate {opponents.rate:g}"
        case "fixed":
            past, why = np.ones(n) / n, "always the same"
        case "exploit":
            read = records(opponents, state, learner, since).rates(names)
            return OpponentDistribution(opponent, names, exploit(read, [str(s.player) for s in pool]), read, WIN_RATE)
        case "alphastar":
            known = records(opponents, state, learner, since)
            own = np.array([s.player == opponent or not opponent for s in pool])
            exploiters = np.array([s.player in _exploiters(state) for s in pool])
            present = known.against(opponent).rate if opponent else None
            read = known.rates(names)
            mixture = alphastar(read, present, own & ~exploiters, exploiters, opponents.mix)
            return OpponentDistribution(opponent, names, mixture, read, WIN_RATE)
        case _:
            past, read, quantity, why = _by_ratings(opponents, state, learner, pool)
    return OpponentDistribution(opponent, names, Mixture(0.0, past, why), read, quantity)


def _by_ratings(
    opponents: Opponents, state: LeagueState, learner: Player, pool: Sequence[Snapshot]
) -> tuple[np.ndarray, np.ndarray, str, str]:
    """Apply a rule that reads rating matches; return the pool's probabilities, the rule's input, its name, why."""
    if opponents.kind == "gaussian":
        read = _predicted(state, learner, pool)
        why = f"normal law of the predicted score, σ = {opponents.sigma:.3g}"
        return gaussian(read, opponents.sigma), read, "predicted score", why
    if opponents.kind == "nash":
        own = _own(state, learner)
        past, value = nash(-_payoffs(opponents, state, own, pool).T)
        read = _payoffs(opponents, state, state.history(learner.name)[-1:], pool)[0]
        why = f"their Nash mixture against all snapshots of {learner.name}'s team, who score {-value:.3f} at best"
        return past, read, "payoff of the newest snapshot", why
    table = _payoffs(opponents, state, pool, pool)
    why = f"their α-rank mass, α = {opponents.alpha:g}"
    return alpharank(table, opponents.alpha).mass, table.mean(1), "mean payoff among them", why


def table_pairs(
    opponents: Opponents, state: LeagueState, learner: Player, team: int, role: Role
) -> list[tuple[str, str]]:
    """Return the pairs of a learner's payoff table for its opponents in another team, newest first.

    Only snapshots that still have their policy, and nothing for a rule without such a table.
    """
    if opponents.kind not in ("nash", "alpharank"):
        return []
    pool = met_in(role, opponents, state, team)
    rows = [s for s in _own(state, learner) if s.thinned is None] if opponents.kind == "nash" else pool
    pairs = sorted(((a, b) for a in rows for b in pool), key=lambda pair: -max(s.iteration for s in pair))
    return [(a.name, b.name) for a, b in pairs if a.name != b.name]


def _own(state: LeagueState, learner: Player) -> list[Snapshot]:
    """Return all snapshots of the players of a learner's team: the rows of its payoff table."""
    return [s for s in state.snapshots if s.player in _players(state, learner.team)]


def records(opponents: Opponents, state: LeagueState, learner: Player, since: int = -1) -> WinRecords:
    """Compute a learner's win rates from its training games so far, or from those after an iteration.

    A snapshot that the learner has not met inherits the win rate of its parent; a player whose present policy it has
    not met inherits that of the player's newest snapshot.
    """
    parts = _parts(state, learner, since)
    return win_records(state.training_games, learner.name, parts, state.parents, opponents.decay, opponents.shrinkage)


def candidate_scores(role: Role, state: LeagueState, learner: Player, since: Snapshot) -> dict[str, Score]:
    """Compute win rates after a snapshot against all candidates; of a main exploiter's, against each player's newest.

    Empty for a role whose generations end at no win rate.
    """
    assert role.opponents is not None
    if role.win_rate is None:
        return {}
    found: dict[str, Score] = {}
    known = records(role.opponents, state, learner, since.iteration)
    for team in sorted({p.team for p in state.players} - {learner.team}):
        pool = met_in(role, role.opponents, state, team)
        if role.opponents.kind == "exploit":
            pool = list({s.player: s for s in pool}.values())
        elif role.opponents.kind == "latest":
            pool = pool[-1:]
        for name in (s.name for s in pool):
            kept = known.against(name)
            low, high = score_interval(kept.score, 0, kept.games - kept.score)
            found[name] = Score(kept.rate, float(low), float(high), int(known.games([name])[0]))
    return found


def qualities(
    opponents: Opponents, state: LeagueState, learner: Player, names: Sequence[str], since: int = -1
) -> np.ndarray:
    """(n,) OpenAI Five's qualities of all snapshots that the learner may ever have met, from its games so far.

    The pool of a turn consisted of the snapshots that were created before it. After thinning, it lacks some of the
    snapshots of that time; a snapshot that was never met until then counts as new.
    """
    frozen = state.by_name
    order = sorted(range(len(names)), key=lambda i: (frozen[names[i]].created, frozen[names[i]].iteration, names[i]))
    parts, found = _parts(state, learner, since), np.zeros(len(names))
    oldest_first = [names[i] for i in order]
    found[order] = quality_scores(state.training_games, learner.name, parts, oldest_first, opponents.rate)
    return found


def _parts(state: LeagueState, learner: Player, since: int = -1) -> list[Part]:
    """Return a learner's training games in order, preceded by those of the player of its team that it was copied from.

    After a reset, return only the games after that iteration, `since`.
    """
    if since >= 0:
        return [Part(learner.name, since)]
    team = {p.name for p in state.players if p.team == learner.team}
    frozen = state.by_name
    name, before, found = learner.name, None, list[Part]()
    for _ in range(len(frozen) + 1):  # copies form no cycle; the bound ends the loop even if they did
        history = [s for s in state.history(name) if before is None or s.iteration <= before]
        parents = [frozen.get(s.parent or "") for s in history]
        copied = [i for i, p in enumerate(parents) if p is not None and p.player in team - {name}]
        found.insert(0, Part(name, history[copied[-1]].iteration if copied else -1, before))
        if not copied or (parent := parents[copied[-1]]) is None or parent.player is None:
            break
        name, before = parent.player, parent.iteration
    return found


def met_in(role: Role, opponents: Opponents, state: LeagueState, team: int) -> list[Snapshot]:
    """Return the candidate snapshots of a team, oldest first: those of its players that the role meets.

    For a fixed opponent, return the victim alone if its roster fits the team.
    """
    if opponents.kind == "fixed":
        rosters = {p.roster for p in state.players if p.team == team}
        return [s for s in state.snapshots if s.name == opponents.victim and s.roster in rosters]
    return [s for s in _ever_met_in(role, state, team) if s.thinned is None]


def _ever_met_in(role: Role, state: LeagueState, team: int) -> list[Snapshot]:
    """Return the snapshots of the team's players that the role meets, oldest first, thinned snapshots included."""
    own = [p.name for p in state.players if p.team == team and (role.meets is None or p.role in role.meets)]
    return sorted((s for name in own for s in state.history(name)), key=lambda s: (s.iteration, s.name))


def _players(state: LeagueState, team: int) -> set[str]:
    return {p.name for p in state.players if p.team == team}


def _exploiters(state: LeagueState) -> set[str]:
    """Names of the exploiters that verify main players: league exploiters are met by PFSP alone, as in AlphaStar."""
    return {p.name for p in state.players if is_exploiter(p.role) and p.role != LEAGUE_EXPLOITER.name}


def _predicted(state: LeagueState, learner: Player, pool: Sequence[Snapshot]) -> np.ndarray:
    """(n,) Scores of the learner as predicted by ratings; ½ for opponents without any rating.

    An unrated snapshot takes the rating of its nearest rated ancestor.
    """
    ladder, frozen = state.ladder, state.by_name
    played = ladder.payoff.played > 0

    def place(snapshot: Snapshot | None) -> int | None:
        while snapshot is not None and not played[ladder.payoff.index(snapshot.name)]:
            snapshot = frozen.get(snapshot.parent or "")
        return None if snapshot is None else ladder.payoff.index(snapshot.name)

    mine = place(state.history(learner.name)[-1])
    if mine is None:
        return np.full(len(pool), 0.5)
    expected = ladder.ratings.expected_from(mine)
    return np.array([0.5 if (at := place(s)) is None else expected[at] for s in pool])


def _payoffs(
    opponents: Opponents, state: LeagueState, rows: Sequence[Snapshot], columns: Sequence[Snapshot]
) -> np.ndarray:
    """(N, M) Scores of rating matches, with `shrinkage` virtual draws: ½ for pairs that never met."""
    payoff = state.ladder.payoff
    places = ([payoff.index(s.name) for s in some] for some in (rows, columns))
    (wins, draws, losses, _), extra = payoff.block(*places), opponents.shrinkage
    games, won = wins + draws + losses, wins + draws / 2
    return np.where(games > 0, (won + extra / 2) / np.maximum(games + extra, 1), 0.5)
