"""Roles of players: kinds of learning lineages. A role is a record; its behaviour follows from its values.

The roles and their resets are AlphaStar's (Vinyals et al. 2019, "Grandmaster level in StarCraft II using multi-agent
reinforcement learning", Methods and published pseudocode: `MainPlayer`, `MainExploiter`, `LeagueExploiter`). A
*generation* of a player begins with its newest snapshot. It ends when the player surely beats all its opponents, or
after a number of steps: then a snapshot of the player is taken, and after that the player may be reset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, get_args
from zlib import crc32

import numpy as np

from matchmaking.opponents import Opponents
from storage.records import Snapshot

Reset = Literal["never", "initial", "main"]


@dataclass(frozen=True)
class Role:
    """A kind of player: its opponents, when a snapshot is taken, and whether it is reset after that."""

    name: str
    """Name used by players. main, main_exploiter, league_exploiter and fixed are built in: a table of such a name
    changes only the fields that it gives. A role of another name starts from main's values."""

    opponents: Opponents | None = None
    """Opponents of its players while they learn (none: training.opponents)."""

    meets: tuple[str, ...] | None = None
    """Roles whose players' snapshots they meet (none: all)."""

    win_rate: float | None = None
    """Take a snapshot when it scores more than this, 0 to 1, against each opponent, with 95 % confidence for each; and
    at `timeout` in any case."""

    timeout: int | None = None
    """Take a snapshot after so many environment steps, 1 or more (none, and no win_rate: after iterations 1, 2, 4,
    ...)."""

    reset: Reset | None = None
    """Continuation after a snapshot: never (go on learning), initial (from its own first policy, with everything else
    new), main (from the newest snapshot of a main player of its team)."""

    reset_chance: float | None = None
    """Probability of the reset, 0 to 1 (none: always)."""

    shaping_steps: int | None = None
    """Environment steps over which the dense reward of its players fades (0: they learn from the outcome only; none: as
    training.shaping_steps or training.shaping_until says)."""

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("name: a role needs one")
        for name in ("win_rate", "reset_chance"):
            value = getattr(self, name)
            if value is not None and not 0 < value <= 1:
                raise ValueError(f"{name}: lies above 0, and is 1 at most")
        if self.win_rate == 1:
            raise ValueError("win_rate: no interval begins above 1; use less, e.g. 0.7")
        if self.timeout is not None and self.timeout < 1:
            raise ValueError("timeout: is a number of environment steps, 1 or more")
        if self.shaping_steps is not None and self.shaping_steps < 0:
            raise ValueError("shaping_steps: is a number of environment steps, 0 or more")
        if self.reset is not None and self.reset not in get_args(Reset):
            raise ValueError(f"reset: choose one of {', '.join(get_args(Reset))}")

    @property
    def has_generations(self) -> bool:
        """True if snapshots follow a rule of its own instead of the usual iterations 1, 2, 4, 8, ...."""
        return self.win_rate is not None or self.timeout is not None

    @property
    def can_reset(self) -> bool:
        """True if a generation may end with a reset."""
        return self.reset in ("initial", "main")

    @property
    def learns(self) -> bool:
        """True if its players ever learn."""
        return self.name != FIXED.name

    def steps_left(self, since: int, steps: int) -> int | None:
        """Return the environment steps until the timeout of a generation; None without a timeout.

        Args:
            since: environment steps of the player when the generation began.
            steps: environment steps of the player now.
        """
        return None if self.timeout is None else max(0, since + self.timeout - steps)

    def reset_after(self, seed: int, player: str, iteration: int) -> bool:
        """Return True if the player is reset after the snapshot of that iteration; repeated calls agree."""
        if not self.can_reset:
            return False
        rng = np.random.default_rng([seed, iteration, crc32(f"{player}/reset".encode())])
        return rng.random() < (1.0 if self.reset_chance is None else self.reset_chance)

    def last_reset(self, seed: int, player: str, history: Sequence[Snapshot]) -> Snapshot | None:
        """Return the snapshot after which the player was last reset, or None; `history` are its own, oldest first."""
        resets = (s for s in reversed(history) if not s.initial and self.reset_after(seed, player, s.iteration))
        return next(resets, None)


MAIN = Role("main")
"""Meets the opponents of `training.opponents`."""

MAIN_EXPLOITER = Role("main_exploiter", Opponents("exploit"), ("main",), 0.7, 1_000_000, "initial")
"""Searches for weaknesses of main players. AlphaStar resets it at a win rate of 70 % or after 4e9 steps."""

LEAGUE_EXPLOITER = Role(
    "league_exploiter", Opponents("pfsp", weighting="linear_capped"), None, 0.7, 500_000, "initial", 0.25
)
"""Searches for weaknesses of all players. AlphaStar ends a generation at 70 % or after 2e9 steps, and resets a
quarter."""

FIXED = Role("fixed")
"""Never learns: it keeps its first policy. Scripts and imported policies have this role too."""

BUILT_IN: Mapping[str, Role] = {role.name: role for role in (MAIN, MAIN_EXPLOITER, LEAGUE_EXPLOITER, FIXED)}


def role_named(name: str, declared: Sequence[Role], default_opponents: Opponents) -> Role:
    """Return the role of that name: as declared, or built in, or as main; with its opponents filled in.

    Args:
        name: as in a player's row.
        declared: a league's own records; None fields are as in the built-in role of that name.
        default_opponents: for roles without opponents.
    """
    base = BUILT_IN.get(name, replace(MAIN, name=name))
    for own in (role for role in declared if role.name == name):
        said = {each.name: value for each in fields(own) if (value := getattr(own, each.name)) is not None}
        base = replace(base, **said)
    return base if base.opponents is not None else replace(base, opponents=default_opponents)


def check_roles(declared: Sequence[Role], used: Sequence[str]) -> None:
    """Raise ValueError, naming role and reason, if roles contradict themselves.

    Args:
        declared: a league's own records.
        used: the roles that its players name.
    """
    known = [*BUILT_IN, *(role.name for role in declared if role.name not in BUILT_IN)]
    for i, role in enumerate(declared):
        resolved = role_named(role.name, declared, Opponents())
        if any(other.name == role.name for other in declared[:i]):
            raise ValueError(f"roles: two are called {role.name}; give each a name of its own")
        if missing := [name for name in role.meets or () if name not in known]:
            raise ValueError(f"roles: {role.name} meets {missing[0]}, and there are {', '.join(known)}")
        if resolved.win_rate is not None and resolved.timeout is None:
            raise ValueError(f"roles: {role.name} has a win_rate and no timeout, and may never reach it; give it one")
        if resolved.can_reset and not resolved.has_generations:
            raise ValueError(f"roles: {role.name} has a reset, and no timeout after which it would happen; give it one")
    for name in used:
        if name not in known:
            raise ValueError(f"players: there is no role {name!r}; use one of {', '.join(known)}, or declare [[roles]]")


def is_exploiter(role: str) -> bool:
    """Return True for roles that search for others' weaknesses: main_exploiter, league_exploiter and the like."""
    return "exploiter" in role


def without_exploiters(roles: Mapping[str, str]) -> set[str]:
    """Return the names whose role is no exploiter's: they tell how strong a league is. Without any, return all.

    An exploiter learns against a weakness of others and is reset again and again, so its score says little of a league.
    """
    return {name for name, role in roles.items() if not is_exploiter(role)} or {*roles}
