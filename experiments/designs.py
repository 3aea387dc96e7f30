"""Designs of rating matches compared at equal numbers of games: the accuracy of the newest snapshots' ratings.

    python -m experiments.designs [--leagues 200] [--out experiments/results/designs-cpu.json]

Simulated leagues: two players of 12 snapshots, each 30 to 60 Elo stronger than the one before, and three scripts.
Matches are planned in batches of four pairs of 128 games: a few while the players learn, the others afterwards. The
score of a pair follows from the gap in strength. To misfit the model, some leagues add a cyclic term: every snapshot
has an angle, and the gap of i to j grows by 100 sin(angle_i - angle_j) Elo, a disc game (Balduzzi et al. 2019), which
no rating can express. The angles of a lineage are a random walk.

For each design, of the fit that a league makes:

  gap_rmse, gap_covered          gap between both newest snapshots: error in Elo against the gap of their strengths,
                                 and how often the fit's 95 % interval holds that gap
  direct_rmse                    error against the gap that decides games between the two, cyclic term included
  initial_rmse, initial_covered  the same for the gaps of the newest snapshots to the initial ones
  pool_rmse                      error in Elo of all players' snapshots
  newest_met                     games between both newest snapshots
  few                            players' snapshots that have met fewer than three others
  past_met                       how often both newest snapshots have met their parent and their own 3 and 10 back

Of statements which of both newest snapshots is stronger, where the truth is the winner of games between them:

  before_wrong                   the snapshot that the fit puts first, which `league run` called stronger before
  before_95_said, before_95_wrong  the same, stated only where the fit is sure to 97.5 %
  said, wrong                    by matchmaking.ratings.comparison: how often it makes a statement, and a wrong one
  fit_said, fit_wrong            its second rule alone, as for two snapshots that have not met
  fit_covered                    how often the interval of that rule, widened by the misfit, holds the direct gap

Prints JSON.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from matchmaking.match_design import HISTORY_OFFSETS, RequiredOpponents, missing_pairs
from matchmaking.match_selection import pairings
from matchmaking.ratings.comparison import compare_snapshots
from matchmaking.ratings.davidson import davidson
from matchmaking.ratings.fit import ELO
from matchmaking.ratings.ladder import Ladder, Pool
from scripts.record import make_parser, report, run_info
from storage.records import ArenaKey, Match, PairCounts

KEY = ArenaKey("bench", "0", "c")
QUOTA, FINAL, PER_BATCH, LENGTH = 128, 512, 4, 12
NU, SIDE = 0.3, 0.1
SCRIPTS = {"idle": -100.0, "random": 0.0, "pusher": 250.0}
REGIMES = {  # numbers of snapshots after which a batch is played during training, and batches afterwards
    "quick start": ((4, 7, 10), 9),
    "long": (tuple(np.repeat(range(2, LENGTH), 3)), 30),
}
Plan = list[tuple[str, str]]


@dataclass
class League:
    """A simulated league: its true strengths, and the matches so far."""

    theta: dict[str, float]  # strength in Elo
    angle: dict[str, float]
    cycle: float  # Elo
    rng: np.random.Generator
    length: int = 1  # snapshots of each player so far
    trained: bool = False
    log: list[Match] = field(default_factory=list)

    @property
    def history(self) -> dict[str, list[str]]:
        """Each player's snapshots, oldest first."""
        return {p: [f"{p}@{i:02d}" for i in range(self.length)] for p in ("blue", "red")}

    @property
    def newest(self) -> list[str]:
        """Both newest snapshots."""
        return [own[-1] for own in self.history.values()]

    def ladder(self) -> Ladder:
        """Return the ladder of the matches so far."""
        own = self.history.values()
        parents = {b: a for names in own for a, b in pairwise(names)}
        names = [*SCRIPTS, *(name for pair in zip(*own, strict=True) for name in pair)]
        return Ladder(Pool(tuple(names), tuple(names[0] for names in own), parents), self.log)

    def gap(self, a: str, b: str) -> float:
        """Return the gap in Elo that decides games between two."""
        return self.theta[a] - self.theta[b] + self.cycle * float(np.sin(self.angle[a] - self.angle[b]))

    def play(self, plan: Plan, games: int = QUOTA) -> None:
        """Play each pair, half with sides swapped; the pairs of an incomplete batch play more, as in a league."""
        for i in range(PER_BATCH if plan else 0):
            a, b = plan[i % len(plan)]
            gap = self.gap(a, b) / ELO
            p = [np.exp(davidson(np.array(gap + side), np.log(NU)).log_likelihood) for side in (SIDE, -SIDE)]
            home, away = (self.rng.multinomial(games // 2, each / each.sum()) for each in p)
            w, d, l = (int(x) for x in home + away)  # noqa: E741
            self.log.append(Match("bench", KEY, a, b, w, d, l, 0, *map(int, home), PairCounts(), seed=0))


def new_league(cycle: float, rng: np.random.Generator) -> League:
    """Return a new league with random strengths."""
    theta, angle = dict(SCRIPTS), {name: float(rng.uniform(0, 2 * np.pi)) for name in SCRIPTS}
    for player in ("blue", "red"):
        steps = np.append(0, np.cumsum(rng.uniform(30, 60, LENGTH - 1)))
        turns = rng.uniform(0, 2 * np.pi) + np.cumsum(rng.normal(0, 0.6, LENGTH))
        theta |= {f"{player}@{i:02d}": float(x) for i, x in enumerate(steps)}
        angle |= {f"{player}@{i:02d}": float(x) for i, x in enumerate(turns)}
    return League(theta, angle, cycle, rng)


# Designs: a league -> the pairs of the next batch --------------------------------------------------------------------


def lookback(history: Sequence[str]) -> list[str]:
    """Return the snapshots 3, 1 (its parent) and 10 before a player's last one, in this order."""
    return [history[-1 - back] for back in (HISTORY_OFFSETS[0], 1, *HISTORY_OFFSETS[1:]) if len(history) > back]


def references(league: League, name: str) -> list[str]:
    """Return the reference opponents of a snapshot: the initial one, two milestones, scripts."""
    own = league.history[name.partition("@")[0]]
    return [other for other in (own[0], *own[3:5], *SCRIPTS) if other != name]


def pool(league: League, **given) -> Plan:
    """Plan by the rule of the pool: the most informative pairs of all snapshots."""
    ladder = league.ladder()
    first = {name: [league.history[name.partition("@")[0]][0]] for name in league.newest}
    everyone = [name for name in ladder.names if name in SCRIPTS]
    everyone += [name for pair in zip(*league.history.values(), strict=True) for name in pair]
    return pairings(ladder, everyone, quota=QUOTA, per_batch=PER_BATCH, always=first, **given)


def before(league: League) -> Plan:
    """Plan as before: after training the newest against reference opponents, otherwise the pool."""
    if league.trained:
        wanted = {name: references(league, name) for name in league.newest}
        found = pairings(
            league.ladder(), list(wanted), quota=FINAL, per_batch=PER_BATCH, always=wanted,
            may_meet=lambda a, b: b in wanted.get(a, ()),
        )  # fmt: skip
        if found:
            return found
    return pool(league)


def at_random(league: League) -> Plan:
    """Plan random pairs."""
    names = [name for own in league.history.values() for name in own] + list(SCRIPTS)
    pairs = [(a, b) for i, a in enumerate(names) for b in names[:i]]
    chosen = league.rng.choice(len(pairs), min(PER_BATCH, len(pairs)), replace=False)
    return [pairs[i] for i in chosen]


def only_pool(league: League) -> Plan:
    """Plan by the pool alone, before and after training."""
    return pool(league)


def round_robin(league: League) -> Plan:
    """Plan only the newest against each other and their initial snapshots, without an end."""
    a, b = league.newest
    own = {
        name: RequiredOpponents((), [other, league.history[name.partition("@")[0]][0]])
        for name, other in ((a, b), (b, a))
    }
    return missing_pairs(league.ladder().payoff, own, quota=QUOTA, target_episodes=10**6)[:PER_BATCH]


def wishes(league: League, *, past: bool = True, early: bool = True) -> dict[str, RequiredOpponents]:
    """Return the wanted opponents of both newest snapshots; unless `early`, their later rounds wait like all others."""
    a, b = league.newest
    found = {}
    for name, other in ((a, b), (b, a)):
        own = league.history[name.partition("@")[0]]
        measures = [own[0], *(lookback(own) if past else ())]
        anchors = references(league, name) if league.trained else list(SCRIPTS)
        found[name] = (
            RequiredOpponents([other], measures, anchors)
            if early
            else RequiredOpponents((), [other, *measures], anchors)
        )
    return found


def filled(league: League, plan: Plan) -> Plan:
    """Fill a batch of these pairs with pairs of the pool."""
    met = {frozenset(pair) for pair in plan[:PER_BATCH]}
    more = [pair for pair in pool(league) if frozenset(pair) not in met] if len(met) < PER_BATCH else []
    return [*plan, *more][:PER_BATCH]


def connected(league: League, rounds: int = 4, **how: bool) -> Plan:
    """Plan all wanted pairs: one round during training, `rounds` afterwards; then the pool."""
    target_episodes = QUOTA * (rounds if league.trained else 1)
    return filled(
        league,
        missing_pairs(league.ladder().payoff, wishes(league, **how), quota=QUOTA, target_episodes=target_episodes),
    )


def one_round(league: League) -> Plan:
    """Plan one round, then the pool."""
    return connected(league, 1)


def side_by_side(league: League) -> Plan:
    """Plan four rounds after training, the newest pair's without precedence."""
    return connected(league, early=False)


def without_past(league: League) -> Plan:
    """Plan without the snapshots 1 (parent), 3 and 10 back."""
    return connected(league, past=False)


def newest_always(league: League) -> Plan:
    """Plan with the newest pair in every batch after training."""
    a, b = league.newest
    plan = connected(league)
    return plan if not league.trained or (a, b) in plan else [(a, b), *plan][:PER_BATCH]


DESIGNS: dict[str, Callable[[League], Plan]] = {
    "before": before, "random": at_random, "pool alone": only_pool, "newest and initial alone": round_robin,
    "connected (now)": connected, "connected, 1 round": one_round, "connected, side by side": side_by_side,
    "connected, without past": without_past, "connected, newest in every batch": newest_always,
}  # fmt: skip


def simulate(design: Callable[[League], Plan], regime: str, cycle: float, seed: int) -> dict[str, float]:
    """Simulate one league from its first snapshot to the end of rating, and return its figures."""
    league = new_league(cycle, np.random.default_rng(seed))
    batches, after = REGIMES[regime]
    for at in batches:
        league.length = int(at) + 1
        league.play(design(league))
    league.length, league.trained = LENGTH, True
    for _ in range(after):
        league.play(design(league))
    return measured(league)


def measured(league: League) -> dict[str, float]:
    """Compute the figures of a league, see the module's docstring."""
    ladder = league.ladder()
    ratings, payoff = ladder.ratings, ladder.payoff
    (a, b), place = league.newest, ladder.payoff.index
    deviation, gap = (
        float(np.sqrt(ratings.variances()[place(a), place(b)])),
        ratings.elo[place(a)] - ratings.elo[place(b)],
    )
    strength, direct = league.theta[a] - league.theta[b], league.gap(a, b)
    now, fitted = compare_snapshots(ladder, a, b), compare_snapshots(ladder, a, b, direct=False)
    newest = [(place(name), 1000 + league.theta[name]) for name in (a, b)]
    everyone = [(place(n), 1000 + league.theta[n]) for own in league.history.values() for n in own]
    met = (payoff.games > 0).sum(1)
    back = [payoff.games[place(n), place(o)] > 0 for n in (a, b) for o in lookback(league.history[n.partition("@")[0]])]
    likelihood = ratings.likelihood_of_superiority(a, b)
    sure = abs(likelihood - 0.5) > 0.475
    figures = {
        "games": payoff.games.sum() / 2, "gap_error": gap - strength, "direct_error": gap - direct,
        "initial_error": _rms([ratings.elo[i] - elo for i, elo in newest]),
        "pool_error": _rms([ratings.elo[i] - elo for i, elo in everyone]),
        "gap_covered": abs(gap - strength) < 1.96 * deviation,
        "initial_covered": np.mean([ratings.low[i] <= elo <= ratings.high[i] for i, elo in newest]),
        "newest_met": payoff.games[place(a), place(b)], "few": (met[[i for i, _ in everyone]] < 3).sum(),
        "past_met": all(back), "before_wrong": gap * direct < 0,
        "before_95_said": sure, "before_95_wrong": sure and gap * direct < 0,
        "said": now.sure, "wrong": now.sure and league.gap(now.first, now.second) < 0,
        "fit_said": fitted.sure, "fit_wrong": fitted.sure and league.gap(fitted.first, fitted.second) < 0,
        "fit_covered": abs(fitted.gap - league.gap(fitted.first, fitted.second)) < fitted.error,
    }  # fmt: skip
    return {name: float(value) for name, value in figures.items()}


def _rms(errors: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def averaged(runs: list[dict[str, float]]) -> dict[str, float]:
    """Average the figures of many leagues."""
    mean = {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}
    for name in ("gap", "direct", "initial", "pool"):
        mean.pop(f"{name}_error")
        mean[f"{name}_rmse"] = _rms([run[f"{name}_error"] for run in runs])
    return {name: round(value, 1 if name.endswith("rmse") or value > 1 else 3) for name, value in mean.items()}


def main() -> None:
    """Simulate every design in every regime."""
    parser = make_parser(__doc__)
    parser.add_argument("--leagues", type=int, default=200, help="simulated leagues of each kind")
    parser.add_argument("--designs", nargs="*", default=list(DESIGNS), choices=list(DESIGNS))
    parser.add_argument("--regimes", nargs="*", default=list(REGIMES), choices=list(REGIMES))
    args = parser.parse_args()
    result: dict = {"leagues": args.leagues, "figures": {}}
    for regime in args.regimes:
        for cycle in (0, 100):
            figures = result["figures"][f"{regime}, cyclic term of {cycle} Elo"] = {}
            for name in args.designs:
                figures[name] = averaged([simulate(DESIGNS[name], regime, cycle, seed) for seed in range(args.leagues)])
    report({**run_info(args.commit), **result}, args.out)


if __name__ == "__main__":
    main()
