"""The lives of players whose role freezes them by a rule of its own: since when, what ends them, and what follows.

A life begins with the player's newest snapshot; no other row says so. A turn that ends a life writes the snapshot, and
the checkpoint of whoever goes on, in its one transaction (`league/train.py`). All here is a function of what the store
holds and of the settings, so plan, trainer and `league status` see the same.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from league.odds import met_in, records
from league.standing import Standing
from matchmaking.payoff import Score, score_interval
from matchmaking.roles import MAIN, Role
from storage.records import Player, Snapshot


@dataclass(frozen=True)
class Life:
    """How a player's life stands."""

    role: Role
    since: Snapshot  # with which it began
    steps: int  # environment steps in it so far
    scores: Mapping[str, Score]  # its win rates of late against those whom it has to beat

    @property
    def left(self) -> int | None:
        """Environment steps until its timeout; None without one."""
        return steps_left(self.role, self.since, self.since.step + self.steps)

    @property
    def won(self) -> bool:
        """Whether it surely beats all."""
        least = self.role.win_rate
        return least is not None and bool(self.scores) and all(s.low > least for s in self.scores.values())

    @property
    def over(self) -> bool:
        """Whether the player is frozen now."""
        return self.steps > 0 and (self.won or self.left == 0)


def steps_left(role: Role, since: Snapshot, steps: int) -> int | None:
    """Environment steps until the timeout of a life that began with a snapshot, after so many of the player in all."""
    return None if role.timeout is None else max(0, since.step + role.timeout - steps)


def life(role: Role, standing: Standing, player: Player, steps: int) -> Life | None:
    """A player's life, after so many steps of its own in all; None where its role has none, or before its first.

    Win rates are those of the games it has learnt from in this life, which the rule of its opponents reads too: each
    game counts `decay` times as much after each further one, so of its policies the newest is told, and the virtual
    draws count as games. Whom it never met in this life counts as the snapshot from which that one goes on. Intervals
    are those of a single look: looked at after each turn, a life ends a little early now and then.
    """
    history = standing.history(player.name)
    if not role.has_lives or not history:
        return None
    since = history[-1]
    return Life(role, since, steps - since.step, _scores(role, standing, player, since))


def _scores(role: Role, standing: Standing, player: Player, since: Snapshot) -> dict[str, Score]:
    """Its win rates against all whom its rule may draw; of a main exploiter's those frozen last."""
    assert role.opponents is not None
    if role.win_rate is None:
        return {}
    found: dict[str, Score] = {}
    known = records(role.opponents, standing, player, since.iteration)
    for team in sorted({p.team for p in standing.players} - {player.team}):
        pool = met_in(role, role.opponents, standing, team)
        if role.opponents.kind == "exploit":
            pool = list({s.player: s for s in pool}.values())
        elif role.opponents.kind == "latest":
            pool = pool[-1:]
        for name in (s.name for s in pool):
            kept = known.against(name)
            low, high = score_interval(kept.score, 0, kept.games - kept.score)
            found[name] = Score(kept.rate, float(low), float(high), int(known.games([name])[0]))
    return found


def born(role: Role, seed: int, player: str, history: Sequence[Snapshot]) -> Snapshot | None:
    """The snapshot after which the player's policy began anew, if it ever did; `history` are its own, oldest first."""
    anew = (s for s in reversed(history) if not s.initial and role.reset_after(seed, player, s.iteration))
    return next(anew, None)


def fresh_since(role: Role, seed: int, player: str, history: Sequence[Snapshot]) -> int:
    """The step at which the player last began with its first policy: from there its dense reward fades."""
    begun = born(role, seed, player, history) if role.reset == "initial" else None
    return begun.step if begun is not None else 0


def parent(role: Role, seed: int, player: Player, standing: Standing) -> str | None:
    """The snapshot from which a player goes on: its newest, or the one with which it then began anew."""
    kept = standing.history(player.name)
    if not kept or born(role, seed, player.name, kept) is not kept[-1]:
        return kept[-1].name if kept else None
    return source(role, player, kept[-1], standing).name


def source(role: Role, player: Player, end: Snapshot | None, standing: Standing) -> Snapshot:
    """From whom a player begins anew after its snapshot `end` (None: now).

    Its own first policy; or the newest snapshot of the main players of its team then, and its own first without any.
    """
    own = standing.history(player.name)[0]
    if role.reset != "main":
        return own
    mains = {p.name for p in standing.players if p.team == player.team and p.role == MAIN.name} - {player.name}
    there = [s for s in standing.snapshots if s.player in mains and (end is None or s.created <= end.created)]
    return max(there, key=lambda s: (s.iteration, s.name), default=own)
