"""Population based training: rules for copying players, and for inheriting and perturbing hyperparameters.

Jaderberg et al. 2017, "Population based training of neural networks" (exploit and explore); by ratings and with
inheritance hyperparameter by hyperparameter as in Liu et al. 2019, "Emergent coordination through competition",
Algorithm 1. Pure functions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

By = Literal["rating", "win_rate"]

HORIZONS = ("gamma", "gae_lambda")
"""Hyperparameters x of which 1 - x is perturbed, because 1 / (1 - x) is a horizon in decisions."""
TUNABLE = ("lr", "critic_lr", "entropy_coef", "clip", *HORIZONS)
"""Settings of the learner that may be tuned: those that do not change the networks' shapes."""
FORMER = {"entropy_coef": "entropy", "gae_lambda": "lam"}
"""The name that a setting of the learner had before, in older leagues' settings and checkpoints."""


@dataclass(frozen=True)
class Pbt:
    """Population based training across the players of a team that have one role; off while `ready` is none."""

    ready: int | None = None
    """Environment steps that a player learns after its start or its last copy before it copies or is copied (none:
    off)."""

    by: By = "rating"
    """Measure of strength: rating, of their newest rated snapshots; win_rate, of their newest training games since
    their last copy, 500 or more, where both meet the same opponents."""

    score: float = 0.45
    """A player copies another if its score against it is below this with 95 % confidence. By win rates the score is one
    half plus the difference of the two win rates."""

    hyperparameters: tuple[str, ...] = field(default=(), metadata={"values_formerly": FORMER})
    """Hyperparameters of the learner to tune: lr, critic_lr, entropy_coef, clip, gamma, gae_lambda."""

    inherit: float = 0.5
    """Probability that a copying player also takes over a hyperparameter, 0 to 1, independently for each."""

    mutate: float = 0.1
    """Probability that a hyperparameter is then perturbed, 0 to 1, independently for each."""

    perturb: float = 1.2
    """Factor of a perturbation: up or down with equal probability."""

    within: float = 10.0
    """Maximum factor by which a hyperparameter may differ from the settings' value, in either direction."""

    def __post_init__(self) -> None:
        """Raise ValueError for impossible values."""
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
        object.__setattr__(self, "hyperparameters", tuple(map(present_name, self.hyperparameters)))
        if unknown := [name for name in self.hyperparameters if name not in TUNABLE]:
            raise ValueError(f"hyperparameters: {unknown[0]} cannot move; use some of {', '.join(TUNABLE)}")
        if len(set(self.hyperparameters)) < len(self.hyperparameters):
            raise ValueError("hyperparameters: name each only once")


def present_name(hyperparameter: str) -> str:
    """Return the present name of a hyperparameter."""
    return next((name for name, former in FORMER.items() if former == hyperparameter), hyperparameter)


def check_pbt(pbt: Pbt, schedule: str, deterministic: bool, lr_adapts: bool) -> None:
    """Raise ValueError if population based training contradicts a league's other settings.

    Args:
        pbt: its settings.
        schedule: the kind of the league's schedule.
        deterministic: the league must end with the same bytes however often it is killed.
        lr_adapts: the learner adapts its learning rate itself.
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
    if "lr" in pbt.hyperparameters and lr_adapts:
        raise ValueError("training.pbt: learner.desired_kl moves lr already; leave one of them out")


def draw_partner(others: Sequence[str], rng: np.random.Generator) -> str | None:
    """Return a player to compare with, uniformly from the others that are ready; None if there is none."""
    return others[int(rng.integers(len(others)))] if others else None


def explore(
    own: Mapping[str, float],
    theirs: Mapping[str, float],
    settings: Mapping[str, float],
    pbt: Pbt,
    rng: np.random.Generator,
) -> dict[str, float]:
    """Return a player's hyperparameters after a copy: each inherited or kept, then perturbed or not.

    Args:
        own: the player's own values, by name, of all that may be tuned.
        theirs: those of the player that it copies.
        settings: the values in the league's settings.
        pbt: probabilities and factors.
        rng: source of random numbers; it is used equally often whatever the result.
    """
    found = {}
    for name in sorted(pbt.hyperparameters, key=lambda name: FORMER.get(name, name)):  # so that older leagues go on
        inherits, mutates, up = rng.random(3) < (pbt.inherit, pbt.mutate, 0.5)
        value, middle = (_scale(name, v[name]) for v in (theirs if inherits else own, settings))
        if mutates:
            value *= pbt.perturb if up else 1 / pbt.perturb
        found[name] = _scale(name, float(np.clip(value, middle / pbt.within, min(middle * pbt.within, 1.0))))
    return found


def _scale(name: str, value: float) -> float:
    """Return the quantity that is perturbed for a hyperparameter, or convert it back."""
    return 1 - value if name in HORIZONS else value
