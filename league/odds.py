"""Whom a learner meets in its next turn, with which probability and why: what the plan draws from, and what `league
explain` prints.

Read off the store alone. Win rates and qualities come from the games that the player has learnt from
(`storage.records.Meeting`, written in the transaction that ends a turn); predicted scores and payoffs from rating
matches. Nothing is remembered between turns, so a restart changes nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from league.standing import Standing
from matchmaking.meta import alpharank, nash
from matchmaking.opponents import (
    Mixture,
    Opponents,
    Qualities,
    Records,
    alphastar,
    by_quality,
    delta_uniform,
    exploit,
    gaussian,
    latest,
    pfsp,
    uniform,
)
from matchmaking.roles import LEAGUE_EXPLOITER, MAIN, Role, is_exploiter
from storage.records import Meeting, Player, Snapshot

WIN_RATE = "win rate"


@dataclass(frozen=True, eq=False)
class Odds:
    """Whom a learner meets in one other team, in those of its groups of worlds that are drawn by the rule.

    `mixture.past` is over `names`; without any of them it is the present opponent.
    """

    opponent: str  # the player that sits there as it is now, "" without one
    names: tuple[str, ...]  # (n,) of snapshots, oldest first
    mixture: Mixture
    read: np.ndarray | None = None  # (n,) what the rule has read: win rates, predicted scores, qualities, payoffs
    told: str = ""  # what that is

    @property
    def weights(self) -> np.ndarray:
        """(n + 1,) Probabilities of the snapshots and, last, of the opponent as it is now."""
        whole = np.append(self.mixture.past, self.mixture.present)
        return whole / whole.sum()


def odds(
    opponents: Opponents, standing: Standing, learner: Player, team: int, opponent: str, role: Role = MAIN,
    since: int = -1,
) -> Odds:  # fmt: skip
    """The odds of a learning player in another team.

    Args:
        opponents: the rule.
        standing: the league.
        learner: the player.
        team: the other team.
        opponent: who sits there now, "" for nobody.
        role: the learner's, which says whose snapshots it meets.
        since: the iteration with which its policy began, if it has begun anew: of its games only later ones count.
    """
    pool = met_in(role, opponents, standing, team)
    names = tuple(s.name for s in pool)
    n, read, told = len(names), None, ""
    if not names:
        return Odds(opponent, (), Mixture(1.0, np.zeros(0), "there is no such snapshot"))
    match opponents.kind:
        case "latest":
            past, why = latest(n), "the newest snapshot"
        case "uniform":
            past, why = uniform(n), "every snapshot alike"
        case "delta_uniform":
            past, why = delta_uniform(n, opponents.delta), f"every snapshot alike but the oldest {opponents.delta:.0%}"
        case "pfsp":
            read, told = records(opponents, standing, learner, since).rates(names), WIN_RATE
            past, why = pfsp(read, opponents.weighting), f"by win rate, weighting {opponents.weighting}"
        case "openai_five":
            ever = [s.name for s in _ever_met_in(role, standing, team)]
            of_all = dict(zip(ever, qualities(opponents, standing, learner, ever, since).tolist(), strict=True))
            read, told = np.array([of_all[name] for name in names]), "quality"
            past, why = by_quality(read), f"softmax of qualities, learning rate {opponents.rate:g}"
        case "fixed":
            past, why = np.ones(n) / n, "always the same"
        case "exploit":
            read = records(opponents, standing, learner, since).rates(names)
            return Odds(opponent, names, exploit(read, [str(s.player) for s in pool]), read, WIN_RATE)
        case "alphastar":
            known = records(opponents, standing, learner, since)
            own = np.array([s.player == opponent or not opponent for s in pool])
            exploiters = np.array([s.player in _exploiters(standing) for s in pool])
            present = known.against(opponent).rate if opponent else None
            read = known.rates(names)
            mixture = alphastar(read, present, own & ~exploiters, exploiters, opponents.mix)
            return Odds(opponent, names, mixture, read, WIN_RATE)
        case _:
            past, read, told, why = _by_ratings(opponents, standing, learner, pool)
    return Odds(opponent, names, Mixture(0.0, past, why), read, told)


def _by_ratings(
    opponents: Opponents, standing: Standing, learner: Player, pool: Sequence[Snapshot]
) -> tuple[np.ndarray, np.ndarray, str, str]:
    """The rules that read rating matches: probabilities of the pool, what was read, what that is, and why."""
    if opponents.kind == "gaussian":
        read = _predicted(standing, learner, pool)
        why = f"normal law of the predicted score, σ = {opponents.sigma:.3g}"
        return gaussian(read, opponents.sigma), read, "predicted score", why
    if opponents.kind == "nash":
        own = [s for s in standing.snapshots if s.player in _players(standing, learner.team)]
        past, value = nash(-_payoffs(opponents, standing, own, pool).T)
        read = _payoffs(opponents, standing, standing.history(learner.name)[-1:], pool)[0]
        why = f"their Nash mixture against all snapshots of {learner.name}'s team, who score {-value:.3f} at best"
        return past, read, "payoff of the newest snapshot", why
    table = _payoffs(opponents, standing, pool, pool)
    why = f"their α-rank mass, α = {opponents.alpha:g}"
    return alpharank(table, opponents.alpha).mass, table.mean(1), "mean payoff among them", why


def records(opponents: Opponents, standing: Standing, learner: Player, since: int = -1) -> Records:
    """A learner's win rates by its training games so far, or by those after an iteration.

    A snapshot that it has not met inherits from the one that it goes on from; a player that it has not met as it is
    now, from that one's newest snapshot.
    """
    parents = {s.name: s.parent for s in standing.snapshots}
    parents |= {s.player: s.name for s in standing.snapshots if s.player}
    known = Records(opponents.decay, opponents.shrinkage, parents)
    for game in _games(standing, learner, since):
        known.note(game.opponent, game.wins, game.draws, game.losses)
    return known


def qualities(
    opponents: Opponents, standing: Standing, learner: Player, names: Sequence[str], since: int = -1
) -> np.ndarray:
    """(n,) OpenAI Five's qualities of all snapshots that the learner may ever have met, from its games so far.

    Once some are thinned a turn's pool is less than all that were there; who was never met until then counts as new.
    """
    known, past = Qualities(opponents.rate), set(names)
    games = [game for game in _games(standing, learner, since) if game.pool and game.opponent in past]
    for _, played in groupby(games, key=lambda game: game.iteration):
        turn = list(played)
        known.add(names[: turn[0].pool])  # those that were there then, the oldest
        known.note(
            [(g.opponent, g.wins + g.draws / 2, g.wins + g.draws + g.losses, g.chance) for g in turn], turn[0].pool
        )
    return known.of(names)


def _games(standing: Standing, learner: Player, since: int = -1) -> list[Meeting]:
    """A learner's training games in their order: after those of a player of its team from which it goes on.

    Where it has begun anew, those that came after that iteration.
    """
    if since >= 0:
        return [m for m in standing.meetings if m.player == learner.name and m.iteration > since]
    team = {p.name for p in standing.players if p.team == learner.team}
    frozen = {s.name: s for s in standing.snapshots}
    name, before, found = learner.name, None, []
    for _ in range(len(frozen) + 1):  # copies could not form a circle, and if they did
        history = [s for s in standing.history(name) if before is None or s.iteration <= before]
        parents = [frozen.get(s.parent or "") for s in history]
        copied = [i for i, p in enumerate(parents) if p is not None and p.player in team - {name}]
        last = history[copied[-1]].iteration if copied else -1
        own = [m for m in standing.meetings if m.player == name and m.iteration > last]
        found = [m for m in own if before is None or m.iteration <= before] + found
        if not copied or (parent := parents[copied[-1]]) is None or parent.player is None:
            break
        name, before = parent.player, parent.iteration
    return found


def met_in(role: Role, opponents: Opponents, standing: Standing, team: int) -> list[Snapshot]:
    """The snapshots that a team can be: those of its players whom the role meets, oldest first; or the victim, where it
    fits.
    """
    if opponents.kind == "fixed":
        rosters = {p.roster for p in standing.players if p.team == team}
        return [s for s in standing.snapshots if s.name == opponents.victim and s.roster in rosters]
    return [s for s in _ever_met_in(role, standing, team) if s.thinned is None]


def _ever_met_in(role: Role, standing: Standing, team: int) -> list[Snapshot]:
    """The snapshots of those of a team's players whom the role meets, oldest first, those that are thinned too."""
    own = {p.name for p in standing.players if p.team == team and (role.meets is None or p.role in role.meets)}
    return sorted((s for s in standing.snapshots if s.player in own), key=lambda s: (s.iteration, s.name))


def _players(standing: Standing, team: int) -> set[str]:
    return {p.name for p in standing.players if p.team == team}


def _exploiters(standing: Standing) -> set[str]:
    """Those by whom main players are verified: league exploiters are met by PFSP alone, as in AlphaStar."""
    return {p.name for p in standing.players if is_exploiter(p.role) and p.role != LEAGUE_EXPLOITER.name}


def _predicted(standing: Standing, learner: Player, pool: Sequence[Snapshot]) -> np.ndarray:
    """(n,) Scores of the learner as ratings predict them; ½ for whom nothing is known.

    Of a snapshot that has not been rated yet those of the one that it goes on from are taken.
    """
    ladder, frozen = standing.ladder, {s.name: s for s in standing.snapshots}
    played = ladder.payoff.games.sum(1) > 0

    def place(snapshot: Snapshot | None) -> int | None:
        while snapshot is not None and not played[ladder.payoff.index(snapshot.name)]:
            snapshot = frozen.get(snapshot.parent or "")
        return None if snapshot is None else ladder.payoff.index(snapshot.name)

    mine = place(standing.history(learner.name)[-1])
    if mine is None:
        return np.full(len(pool), 0.5)
    expected = ladder.ratings.expected_scores()[mine]
    return np.array([0.5 if (at := place(s)) is None else expected[at] for s in pool])


def _payoffs(
    opponents: Opponents, standing: Standing, rows: Sequence[Snapshot], columns: Sequence[Snapshot]
) -> np.ndarray:
    """(N, M) Scores of rating matches, with the virtual draws that `shrinkage` says: ½ for those that never met."""
    payoff = standing.ladder.payoff
    place = np.ix_([payoff.index(s.name) for s in rows], [payoff.index(s.name) for s in columns])
    games, extra = payoff.games[place], opponents.shrinkage
    won = payoff.wins[place] + payoff.draws[place] / 2
    return np.where(games > 0, (won + extra / 2) / np.maximum(games + extra, 1), 0.5)
