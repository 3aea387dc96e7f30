"""Population based training: who of a team's players copies whom, and how hyperparameters are inherited and perturbed.

Jaderberg et al. 2017, "Population based training of neural networks" (exploit and explore); by ratings and with
inheritance hyperparameter by hyperparameter as in Liu et al. 2019, "Emergent coordination through competition",
Algorithm 1. Pure functions: values in, values out.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

By = Literal["rating", "win_rate"]

HORIZONS = ("gamma", "lam")
"""Hyperparameters of which 1 - x is what is multiplied: by it a horizon in decisions is told."""
MOVABLE = ("lr", "critic_lr", "entropy", "clip", *HORIZONS)
"""The learner's settings that may move: those without which the networks have the same shapes."""


@dataclass(frozen=True)
class Pbt:
    """Population based training across the players of a team that have one role; off while `ready` is none."""

    ready: int | None = None
    """Environment steps that a player learns after its beginning or its last copy before it copies or is copied."""

    by: By = "rating"
    """What tells who is stronger: rating, that of their newest rated snapshots; win_rate, that of their newest training
    games since their last copy, 500 or more, where both meet the same opponents."""

    score: float = 0.45
    """A player copies another where it surely scores less than this against it: where the 95 % interval ends below. By
    win rates it is one half and what one's lies above the other's."""

    hyperparameters: tuple[str, ...] = ()
    """Those of the learner that may move: lr, critic_lr, entropy, clip, gamma, lam."""

    inherit: float = 0.5
    """How likely who copies takes over a hyperparameter too, 0 to 1, each by itself."""

    mutate: float = 0.1
    """How likely one is then perturbed, 0 to 1, each by itself."""

    perturb: float = 1.2
    """The factor by which: up or down, one as likely as the other."""

    within: float = 10.0
    """The factor by which one may be larger or smaller than the settings have it, at most."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        if self.ready is not None and self.ready < 1:
            raise ValueError("ready: is a number of environment steps, 1 or more")
        if self.by not in get_args(By):
            raise ValueError(f"by: choose one of {', '.join(get_args(By))}")
        if not 0 < self.score <= 0.5:
            raise ValueError("score: lies above 0, and is 0.5 at most, which equals score")
        for name in ("inherit", "mutate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name}: is a probability, between 0 and 1")
        for name in ("perturb", "within"):
            if not 1 <= getattr(self, name) <= 1000:
                raise ValueError(f"{name}: is a factor, between 1 and 1000")
        if unknown := [name for name in self.hyperparameters if name not in MOVABLE]:
            raise ValueError(f"hyperparameters: {unknown[0]} cannot move; use some of {', '.join(MOVABLE)}")
        if len(set(self.hyperparameters)) < len(self.hyperparameters):
            raise ValueError("hyperparameters: name each only once")


def check_pbt(pbt: Pbt, schedule: str, deterministic: bool, lr_moves: bool) -> None:
    """Refuse what contradicts a league's other settings: ValueError, which says why.

    Args:
        pbt: its settings.
        schedule: the kind of its schedule.
        deterministic: whether it is to end with the same bytes however often it is killed.
        lr_moves: whether the learner moves its step size itself.
    """
    if pbt.ready is None:
        if pbt != Pbt():
            raise ValueError("training.pbt: nobody copies anybody while training.pbt.ready is none; give it steps")
        return
    if deterministic and pbt.by == "rating":
        raise ValueError(
            'deterministic: training.pbt.by = "rating" follows rating matches, which end in no fixed order; use'
            ' "win_rate"'
        )
    if schedule == "ladder":
        raise ValueError("training.pbt: the schedule ladder copies players itself; use another kind")
    if "lr" in pbt.hyperparameters and lr_moves:
        raise ValueError("training.pbt: learner.kl_step moves lr already; leave one of them out")


def partner(others: Sequence[str], rng: np.random.Generator) -> str | None:
    """With whom of the others that are ready a player compares itself: each as likely as another; None without any."""
    return others[int(rng.integers(len(others)))] if others else None


def explored(
    own: Mapping[str, float],
    theirs: Mapping[str, float],
    settings: Mapping[str, float],
    pbt: Pbt,
    rng: np.random.Generator,
) -> dict[str, float]:
    """A player's hyperparameters after a copy: each inherited or kept, then perturbed or not.

    Args:
        own: the player's own, by name, of all that may move.
        theirs: those of the player that it copies.
        settings: as the league's settings have them.
        pbt: with which probabilities and factors.
        rng: the dice; the same number is thrown whatever comes of it.
    """
    found = {}
    for name in sorted(pbt.hyperparameters):
        inherits, mutates, up = rng.random(3) < (pbt.inherit, pbt.mutate, 0.5)
        value, middle = (_scale(name, v[name]) for v in (theirs if inherits else own, settings))
        if mutates:
            value *= pbt.perturb if up else 1 / pbt.perturb
        found[name] = _scale(name, float(np.clip(value, middle / pbt.within, min(middle * pbt.within, 1.0))))
    return found


def _scale(name: str, value: float) -> float:
    """What of a hyperparameter is multiplied, and back again."""
    return 1 - value if name in HORIZONS else value
