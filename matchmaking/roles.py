"""Roles: what kind of player a learning lineage is. A role is a record; its behaviour is in the values it holds.

The roles and what ends their lives are AlphaStar's (Vinyals et al. 2019, "Grandmaster level in StarCraft II using
multi-agent reinforcement learning", Methods and published pseudocode: `MainPlayer`, `MainExploiter`,
`LeagueExploiter`). A *life* of a player begins with its newest snapshot. It ends when the player surely beats whom it
meets, or has learnt for so many steps in it: then the player is frozen, and after that it may begin anew.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, get_args
from zlib import crc32

import numpy as np

from matchmaking.opponents import Opponents

Reset = Literal["never", "initial", "main"]


@dataclass(frozen=True)
class Role:
    """A kind of player: whom it learns against, when it is frozen, and whether it begins anew after that."""

    name: str
    """As players name it. main, main_exploiter, league_exploiter and fixed are there already: what a table of that name
    leaves out is as it was. In a role of another name it is as in main."""

    opponents: Opponents | None = None
    """Whom its players learn against (none: as training.opponents says)."""

    meets: tuple[str, ...] | None = None
    """Roles whose players' snapshots they meet (none: all)."""

    win_rate: float | None = None
    """It is frozen when it surely scores more than this against each whom it meets, 0 to 1: when the 95 % interval of
    each of its win rates begins above it; and when `timeout` is over all the same."""

    timeout: int | None = None
    """It is frozen after so many environment steps, 1 or more (none, and no win_rate: on the axis 1, 2, 4, ...)."""

    reset: Reset | None = None
    """From what it goes on when it was frozen: never (from itself), initial (from its own first policy, with all else
    fresh), main (from the newest snapshot of a main player of its team)."""

    reset_chance: float | None = None
    """How likely it is that this happens, 0 to 1 (none: it always does)."""

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
        if self.reset is not None and self.reset not in get_args(Reset):
            raise ValueError(f"reset: choose one of {', '.join(get_args(Reset))}")

    @property
    def has_lives(self) -> bool:
        """Whether it is frozen by a rule of its own instead of on the axis of the league."""
        return self.win_rate is not None or self.timeout is not None

    @property
    def begins_anew(self) -> bool:
        """Whether a life may end with a reset."""
        return self.reset in ("initial", "main")

    @property
    def learns(self) -> bool:
        """Whether its players ever learn."""
        return self.name != FIXED.name

    def reset_after(self, seed: int, player: str, iteration: int) -> bool:
        """Whether the player begins anew after the snapshot of that iteration: the same answer whenever it is asked."""
        dice = np.random.default_rng([seed, iteration, crc32(f"{player}/reset".encode())])
        return self.begins_anew and dice.random() < (1.0 if self.reset_chance is None else self.reset_chance)


MAIN = Role("main")
"""Meets whoever `training.opponents` says."""

MAIN_EXPLOITER = Role("main_exploiter", Opponents("exploit"), ("main",), 0.7, 1_000_000, "initial")
"""Looks for what main players cannot do. AlphaStar's ends its life at 70 % or after 4e9 steps."""

LEAGUE_EXPLOITER = Role(
    "league_exploiter", Opponents("pfsp", weighting="linear_capped"), None, 0.7, 500_000, "initial", 0.25
)
"""Looks for what nobody can do. AlphaStar's ends its life at 70 % or after 2e9 steps, and begins anew in a quarter."""

FIXED = Role("fixed")
"""Never learns: it stays the policy that it began with. Scripts and imported policies are told to be fixed too."""

BUILT_IN: Mapping[str, Role] = {role.name: role for role in (MAIN, MAIN_EXPLOITER, LEAGUE_EXPLOITER, FIXED)}


def role_named(name: str, declared: Sequence[Role], otherwise: Opponents) -> Role:
    """The role of that name: as it is declared, else built in, else as main; its opponents filled in.

    Args:
        name: as in a player's row.
        declared: a league's own records; what is None in one is as in the built-in role of its name.
        otherwise: whom players meet whose role does not say it.
    """
    base = BUILT_IN.get(name, replace(MAIN, name=name))
    for own in (role for role in declared if role.name == name):
        said = {each.name: value for each in fields(own) if (value := getattr(own, each.name)) is not None}
        base = replace(base, **said)
    return base if base.opponents is not None else replace(base, opponents=otherwise)


def check_roles(declared: Sequence[Role], used: Sequence[str]) -> None:
    """Refuse what contradicts itself: ValueError, which says who and why.

    Args:
        declared: a league's own records.
        used: the roles that its players name.
    """
    known = [*BUILT_IN, *(role.name for role in declared if role.name not in BUILT_IN)]
    for i, role in enumerate(declared):
        whole = role_named(role.name, declared, Opponents())
        if any(other.name == role.name for other in declared[:i]):
            raise ValueError(f"roles: two are called {role.name}; give each a name of its own")
        if missing := [name for name in role.meets or () if name not in known]:
            raise ValueError(f"roles: {role.name} meets {missing[0]}, and there are {', '.join(known)}")
        if whole.win_rate is not None and whole.timeout is None:
            raise ValueError(f"roles: {role.name} has a win_rate and no timeout, and may never reach it; give it one")
        if whole.begins_anew and not whole.has_lives:
            raise ValueError(f"roles: {role.name} has a reset, and no timeout after which it would happen; give it one")
    for name in used:
        if name not in known:
            raise ValueError(f"players: there is no role {name!r}; use one of {', '.join(known)}, or declare [[roles]]")


def is_exploiter(role: str) -> bool:
    """Whether a player of that role looks for others' weaknesses: main_exploiter, league_exploiter and the like."""
    return "exploiter" in role
