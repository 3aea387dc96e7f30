"""Generations of players whose role has a rule for snapshots and resets: their start, their end, and the reset.

A generation begins with the player's newest snapshot; no other row records it. The turn that ends a generation writes
the snapshot and the checkpoint of the player that continues in its one transaction (`league/training/trainer.py`). All
functions here depend on the store and the settings only, so scheduler, trainer and `league status` agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from league.scheduling.opponent_sampling import candidate_scores
from league.state.league_state import LeagueState
from matchmaking.ratings.scores import Score
from matchmaking.roles import MAIN, Role
from storage.records import Player, Snapshot


@dataclass(frozen=True)
class Generation:
    """Progress of a player's current generation."""

    role: Role
    since: Snapshot  # the snapshot with which the generation began
    steps: int  # environment steps in it so far
    scores: Mapping[str, Score]  # recent win rates against the opponents that it has to beat

    @property
    def left(self) -> int | None:
        """Environment steps until its timeout; None without one."""
        return self.role.steps_left(self.since.step, self.since.step + self.steps)

    @property
    def won(self) -> bool:
        """Return whether the lower end of each win rate is above the win rate that the role requires."""
        least = self.role.win_rate
        return least is not None and bool(self.scores) and all(s.low > least for s in self.scores.values())

    @property
    def over(self) -> bool:
        """Return whether the generation ends now, with a snapshot."""
        return self.steps > 0 and (self.won or self.left == 0)


def current_generation(role: Role, state: LeagueState, player: Player, steps: int) -> Generation | None:
    """Return a player's current generation, after `steps` environment steps of the player in all.

    None for a role without generations, and before the player's first snapshot.

    Win rates come from the games that the player has learnt from in this generation, which opponent sampling reads
    too. Each game counts `decay` times as much after each further game, so the newest policy dominates, and virtual
    draws count as games. An opponent that was not met in this generation counts as its parent snapshot. The intervals
    are those of a single test: since they are tested after each turn, a generation sometimes ends a little early.
    """
    history = state.history(player.name)
    if not role.has_generations or not history:
        return None
    since = history[-1]
    return Generation(role, since, steps - since.step, candidate_scores(role, state, player, since))


def initial_policy_since(role: Role, seed: int, player: str, history: Sequence[Snapshot]) -> int:
    """Return the step at which the player last began with its initial policy: its reward shaping decays from there."""
    reset = role.last_reset(seed, player, history) if role.reset == "initial" else None
    return reset.step if reset is not None else 0


def parent(role: Role, seed: int, player: Player, state: LeagueState) -> str | None:
    """Return the name of the snapshot that a player continues from: its newest, or the source of its reset."""
    kept = state.history(player.name)
    if not kept or role.last_reset(seed, player.name, kept) is not kept[-1]:
        return kept[-1].name if kept else None
    return source(role, player, kept[-1], state).name


def source(role: Role, player: Player, end: Snapshot | None, state: LeagueState) -> Snapshot:
    """Return the snapshot that a player is reset to after its snapshot `end` (None: now).

    That is its own first policy, or for a role that resets to main players, the newest snapshot that the main players
    of its team had at that time (its own first policy if they had none).
    """
    own = state.history(player.name)[0]
    if role.reset != "main":
        return own
    mains = {p.name for p in state.players if p.team == player.team and p.role == MAIN.name} - {player.name}
    there = [s for s in state.snapshots if s.player in mains and (end is None or s.created <= end.created)]
    return max(there, key=lambda s: (s.iteration, s.name), default=own)
