"""Settings of opponent sampling in a league's configuration."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple, get_args

from matchmaking.opponents.records import DECAY, SHRINKAGE
from matchmaking.opponents.rules import PFSP_SHARE, SELF_PLAY_SHARE, VERIFICATION_SHARE, Weighting, check_mix

Kind = Literal[
    "latest", "uniform", "delta_uniform", "pfsp", "openai_five", "alphastar", "exploit", "gaussian", "nash",
    "alpharank", "fixed", "prioritized",
]  # fmt: skip

PAST: Mapping[str, float] = {"latest": 0.0, "openai_five": 0.2}
"""Default share of worlds against past opponents; it is 1 for the other rules."""

USED_BY: Mapping[str, tuple[str, ...]] = {
    "delta": ("delta_uniform",), "weighting": ("pfsp",), "rate": ("openai_five",), "mix": ("alphastar",),
    "sigma": ("gaussian",), "alpha": ("alpharank",), "victim": ("fixed",),
    "decay": ("pfsp", "alphastar", "exploit"), "shrinkage": ("pfsp", "alphastar", "exploit", "nash", "alpharank"),
    "await_matches": ("nash", "alpharank"),
}  # fmt: skip
"""Rules that read a setting. With another rule the setting would have no effect, and is refused."""

BY_RATINGS = ("gaussian", "nash", "alpharank")
"""Rules that depend on rating matches, which end in no fixed order."""


class Split(NamedTuple):
    """Numbers of groups of a learner's worlds that play present opponents and opponents drawn by the rule."""

    present: int
    past: int


@dataclass(frozen=True)
class Opponents:
    """Opponents of a learning player."""

    kind: Kind = "latest"
    """Rule for past snapshots: latest; uniform over the history; delta_uniform (with `delta`, Bansal et al.); pfsp, by
    win rate (with `weighting`, AlphaStar); openai_five, by quality (with `rate`); alphastar, the mix of its main
    players (with `mix`); exploit, that of its main exploiters (the newest, or its past where that is too strong);
    gaussian, by predicted win probability (with `sigma`, FTW); nash or alpharank (with `alpha`), the mixture of the
    payoff table (PSRO); fixed, one `victim`. prioritized is an older word for pfsp."""

    past: float | None = None
    """Share of the worlds, 0 to 1, that play past snapshots; all others play the opponents' present policies (none: as
    published, 0 by latest, 0.2 by openai_five, as mix says by alphastar, else 1)."""

    delta: float = 0.0
    """For delta_uniform: oldest share of the history to leave out, 0 to 1."""

    weighting: Weighting = "squared"
    """For pfsp, with win rate x: squared (1-x)², variance x(1-x), linear 1-x, linear_capped min(½, 1-x)."""

    rate: float = 0.01
    """For openai_five: learning rate η, by which a won game lowers an opponent's quality."""

    mix: tuple[float, float, float] = (PFSP_SHARE, SELF_PLAY_SHARE, VERIFICATION_SHARE)
    """For alphastar: shares of PFSP over all snapshots, of self-play and of verification; they sum to 1."""

    sigma: float = 1 / 6
    """For gaussian: standard deviation of the win probability around one half."""

    alpha: float = 100.0
    """For alpharank: selection intensity in a population of 50."""

    victim: str = ""
    """For fixed: the snapshot or script to play against, e.g. red@16 or pusher."""

    decay: float = DECAY
    """Factor by which each later game reduces the weight of a training game in the win rates."""

    shrinkage: float = SHRINKAGE
    """Virtual draws at the start of win rates and payoffs: they stay near one half until there are enough games."""

    await_matches: bool = False
    """For nash and alpharank: begin a turn only when all pairs of the payoff table have met for
    rating.episodes_per_pair episodes, as in PSRO. Training waits for these matches, whatever rating.share is. Otherwise
    pairs that have not met count as even."""

    groups: int = 8
    """Equal groups of a learner's worlds, including those with present opponents; each other group meets one
    snapshot."""

    episodes: int = 4
    """So many of the arena's longest episodes a group keeps its snapshot, unless the rule has come to draw another (0:
    for a turn). Where it changes, worlds begin anew: with a new one each turn, long games would never reach their end.
    """

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind is {self.kind!r}; choose one of {', '.join(get_args(Kind))}")
        if self.kind == "prioritized":  # settings of older leagues
            object.__setattr__(self, "kind", "pfsp")
        for name, low, high in (("past", 0, 1), ("delta", 0, 1), ("decay", 0, 1)):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} is {value}; it is a share and must lie between 0 and 1")
        for name in ("rate", "sigma", "alpha"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        if self.episodes < 0:
            raise ValueError(f"episodes is {self.episodes}; it is a number of episodes, 0 or more")
        if self.shrinkage < 0:
            raise ValueError(f"shrinkage is {self.shrinkage}; it is a number of games, 0 or more")
        if self.weighting not in get_args(Weighting):
            raise ValueError(f"weighting is {self.weighting!r}; choose one of {', '.join(get_args(Weighting))}")
        check_mix(self.mix)
        self._check_use()
        fewest = 2 if 0 < self.share < 1 else 1
        if self.groups < fewest:
            why = f", for present and past opponents (past = {self.share})" if fewest == 2 else ""
            raise ValueError(f"groups is {self.groups}; it must be {fewest} or more{why}")

    def _check_use(self) -> None:
        """Raise ValueError for settings without effect, and for missing ones."""
        defaults = {each.name: each.default for each in fields(self)}
        for name, kinds in USED_BY.items():
            if getattr(self, name) != defaults[name] and self.kind not in kinds:
                use = " or ".join(f"kind = {kind!r}" for kind in kinds)
                raise ValueError(f"{name}: does nothing with kind = {self.kind!r}; use {use}")
        if self.kind == "alphastar" and self.past is not None:
            raise ValueError("past: does nothing with kind = 'alphastar'; its shares are in mix")
        if self.kind != "latest" and not self.share:
            raise ValueError(f"kind = {self.kind!r} does nothing with past = 0; give past > 0, e.g. 0.2")
        if self.kind == "fixed" and not self.victim:
            raise ValueError("victim: kind = 'fixed' needs one; give victim, a snapshot or script, e.g. red@16")

    @property
    def share(self) -> float:
        """Share of the worlds whose opponents are drawn by the rule."""
        return PAST.get(self.kind, 1.0) if self.past is None else self.past

    def split(self) -> Split:
        """Return the groups against present opponents and by the rule, rounded to groups, none of both empty.

        If all opponents are present there is one group, because all worlds are alike.
        """
        share = self.share
        if share in (0, 1):
            return Split(0, self.groups) if share else Split(1, 0)
        past = min(max(round(share * self.groups), 1), self.groups - 1)
        return Split(self.groups - past, past)

    @property
    def actual_share(self) -> float:
        """Share of the worlds that are really drawn by the rule, after rounding to groups."""
        present, past = self.split()
        return past / (present + past)
