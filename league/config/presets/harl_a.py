"""Presets of HARL-A (Peterson et al. 2025): its table of settings, and its games from the first step to the matches."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from agents.settings import Architecture, HappoConfig
from league.config.experiment import Config, default
from league.config.flags import merged
from league.config.sections import Budget
from league.config.stages import Stage
from matchmaking.schedule import Schedule


def harl_a() -> Config:
    """HARL-A's table of settings (Peterson et al., 2025) in its sumo of 2v2 rovers; for a GPU.

    5,000 worlds × 200 decisions per iteration, HAPPO, and the leapfrog schedule of all its jobs, in turns of 50
    million environment steps, 10 billion in total. (An outdated script in its code for these rovers has turns of 100
    million and ends after 1 billion.) HARL-A uses 10,000 worlds for Galaga. Its jobs start from policies of a
    curriculum, this preset starts from fresh policies. Further differences:

    - HARL-A counts at the start of an iteration, so its first turn is one iteration shorter than the others; ours is
      not.
    - Its value normaliser has the deviation 0.1 before the first return, ours has 1. This affects the advantages of the
      first update.
    - It standardises advantages by the unbiased deviation, ours by the biased one: a relative difference of half a
      millionth here.
    - Its first episodes begin with random clocks and end in timeouts with a cost; ours are truncated and bootstrapped.
    - It replaces observations that are not finite by numbers and continues; ours makes such episodes void.
    - Defects of its arenas are repaired (`arena.rules.defects` restores them), physics is MuJoCo's instead of PhysX's,
      and the rovers' masses are our own, since HARL-A's are not published.
    - Random numbers differ, with the same seed, 1. Snapshots and ratings are additions that do not change learning.
    """
    config = default("sumo-2v2-leatherback")
    learner = HappoConfig(
        Architecture((128, 128), "relu", layer_norm=True), lr=5e-4, critic_lr=5e-4, gamma=0.99, gae_lambda=0.95,
        clip=0.2, entropy_coef=0.01, epochs=5, minibatches=1, max_grad_norm=10.0, huber_delta=10.0, initial_std=0.36553,
        fixed_order=True,
    )  # fmt: skip
    training = replace(
        config.training, worlds=5000, rollout_length=200, schedule=Schedule("leapfrog", period_steps=50_000_000),
        shaping_steps=0,
    )  # fmt: skip
    budget = Budget(steps=10_000_000_000)
    return replace(config, league="harl_a", learner=learner, training=training, budget=budget)


def walk() -> Config:
    """Any robot with feet learns to walk to a point, as in HARL-A's first stage; `--arena.blue` names it. For a GPU."""
    config = _ladder("walk")
    learner = replace(config.learner, desired_kl=0.01)  # humanoids learn from smaller updates than the ANYmal
    budget = Budget(steps=1_000_000_000, success=0.9, rating_time="1m")
    return replace(config, learner=learner, budget=budget, stages=())


def by_team() -> Config:
    """HARL-A's sumo of unlike teams, from the first step to the matches: two ANYmals against two Leatherbacks."""
    return _ladder("sumo-by-team", *SUMO, match=ONE_ACTOR)


def within_team() -> Config:
    """HARL-A's sumo of unlike team-mates, from the first step to the matches: an ANYmal and a Leatherback each."""
    return _ladder("sumo-within-team", *SUMO, match=_far(0.98, 120, 8))


def soccer_1v1() -> Config:
    """HARL-A's soccer of one ANYmal against one Leatherback, from the first step to the matches."""
    return _ladder("soccer-1v1", *SOCCER, match=merged(_soccer_match(), FADING))


def soccer_2v2() -> Config:
    """HARL-A's soccer of two ANYmals against two Leatherbacks, from the first step to the matches."""
    return _ladder("soccer-2v2", *SOCCER, match=_soccer_match())


def galaga_1v1() -> Config:
    """3D Galaga of one tank and one drone that see each other: each learns alone first, to aim a little and to fly."""
    aim, fly = {"steps": 3_000_000}, {"steps": 20_000_000}
    return _ladder("galaga-1v1", *_galaga("1v1", SEEN, aim, fly), match=SIGHT)


def galaga_2v2() -> Config:
    """3D Galaga of two tanks and two drones within walls, hit by a ray of 0.5 m: each learns alone first."""
    aim, fly = {"steps": 1_500_000}, {"steps": 20_000_000}
    return _ladder("galaga-2v2", *_galaga("2v2", SEEN_2V2, aim, fly), match=NARROW)


def _ladder(arena: str, *stages: Stage, match: Mapping[str, Any] | None = None) -> Config:
    """Return a league of HARL-A's stages and a last stage of matches; `match` has settings beside those of `MATCH`.

    Budgets are for a GPU; `--steps` bounds each of them. With this learner an ANYmal walks after 2 million steps
    (docs/arenas/anymal-walk.md).
    """
    config = default(arena)
    learner = HappoConfig(
        Architecture((128, 128, 128), "elu"), lr=1e-3, critic_lr=1e-3, gamma=0.99, initial_std=0.6,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, shaping_steps=50_000_000, snapshots_per_doubling=4)
    last = Stage("match", merged(MATCH, match or {}))
    budget = Budget(rating_time="5m")
    return replace(config, league=arena, learner=learner, training=training, budget=budget, stages=(*stages, last))


MATCH = {
    "learner": {"lr": 3e-4, "gamma": 0.995}, "training": {"rollout_length": 48, "shaping_steps": 0},
    "budget": {"steps": 500_000_000},
}  # fmt: skip
"""Settings of matches, which begin with new critics: small updates, a long horizon, and the outcome alone as reward.

HARL-A's figures were reached with these (docs/results.md), and missed with the learner of the stages before."""


ONE_ACTOR = {"learner": {"share_actors": True}}
"""Matches of equal team-mates with one actor, which learns from both: ANYmals are sooner stronger (docs/results.md)."""


def _far(gae_lambda: float, rollout_length: int, minibatches: int) -> dict[str, Any]:
    """Return settings by which advantages look further ahead, so that a robot does not forget what it can do.

    Measured in soccer from players that score, and within team (docs/results.md). Stages in which a robot learns
    something new keep λ = 0.95: one that could not score yet learnt little with λ = 1.
    """
    learner = {"gae_lambda": gae_lambda, "minibatches": minibatches}
    return {"learner": learner, "training": {"rollout_length": rollout_length}}


def _soccer_match() -> dict[str, Any]:
    """Return the settings of soccer's matches beside those of `MATCH`."""
    return {"arena": {"rules": FREE}, **_far(0.99, 240, 20)}


RATING = {"share": 0.3}
"""Rating of stages that ratings end: a batch of 6.5 s of an H100 takes 65 s at a tenth of its time, and a stage
that has reached its bar trains on until the next batch is over."""


def _stage(name: str, arena: str, **budget: Any) -> Stage:
    return Stage(name, {"arena": {"name": arena}, "budget": budget, "rating": RATING})


def _scoring(arena: str, ease: float, rules: Mapping[str, Any], far: bool = False, **budget: Any) -> Stage:
    """Return a stage in which a robot learns to score, by settings that succeeded (docs/results.md).

    With `ease` the robot begins on the way to the goal. The dense reward is strong and fades by success, positions
    alone earn nothing, the discount is close to 1 and updates are small. With `far` the robot scores already, and
    learns from whole returns (λ = 1).
    """
    reward = {"approach": 1.0, "push": 4.0, "near": 0.0, "ball": 0.0}
    name = arena.removeprefix("soccer-") + ("-easy" if ease else "-far" if far else "")
    settings = {
        "arena": {"name": arena, "reward": reward, "rules": {**rules, "ease": ease}}, "budget": budget,
        "learner": {"lr": 3e-4, "desired_kl": 0.01, "gamma": 0.997},
        "training": {"shaping_until": 0.9, "shaping_steps": "none"}, "rating": RATING,
    }  # fmt: skip
    # With as many worlds as in the trial: a rollout is long, and a longer one would learn from older policies.
    whole_returns = merged(_far(1.0, 480, 40), {"learner": {"entropy_coef": 0.0}, "training": {"worlds": 2048}})
    return Stage(name, merged(settings, whole_returns if far else {}))


SUMO = (
    _stage("walk", "anymal-walk", success=0.9, steps=200_000_000),
    _stage("push-anymal", "block-push-anymal", score=0.8, against=["idle"], plateau=6, steps=30_000_000),
    _stage("push-leatherback", "block-push-leatherback", score=0.8, against=["idle"], plateau=6, steps=50_000_000),
)
FREE = {"drive_scale": 40.0, "steer_scale": 0.5}
"""Rules for a Leatherback in soccer: full throttle is at an action of 1.25 and not of 5, which exploration never
reaches."""
SOCCER = (
    _stage("walk", "soccer-walk", success=0.9, steps=200_000_000),
    _stage("ball", "soccer-ball", success=0.9, steps=100_000_000),
    _scoring("soccer-score", 1.0, {}, success=0.7, steps=25_000_000),
    _scoring("soccer-score", 0.0, {}, success=0.7, steps=200_000_000),
    _scoring("soccer-score-leatherback", 1.0, FREE, success=0.7, steps=25_000_000),
    _scoring("soccer-score-leatherback", 0.0, FREE, success=0.7, steps=30_000_000),
    _scoring("soccer-score-leatherback", 0.0, FREE, far=True, success=0.7, steps=100_000_000),
)

FADING = {
    "arena": {"reward": {"approach": 0.5, "push": 2.0, "ball": 0.0}},
    "learner": {"desired_kl": 0.01, "gamma": 0.997},
    "training": {"worlds": 2048, "shaping_steps": 60_000_000, "opponents": {"kind": "uniform", "past": 0.5}},
}  # fmt: skip
"""Matches one on one with a dense reward that fades, larger steps and a history: both sides surely rise from players
that score (docs/results.md); two on two nobody does."""


SEEN, SEEN_2V2 = 8, 14
"""Numbers behind the observations of Galaga one on one and two on two, whose sides see each other in matches."""
SIGHT = {
    "arena": {"rich": True, "buffer": SEEN},
    "training": {
        "schedule": {"kind": "leapfrog", "learner": 1, "until_score": 0.8, "period_steps": 15_000_000},
        "opponents": {"kind": "uniform", "past": 0.5},
    },
}  # fmt: skip
"""Matches in which both sides learn: the drone sees the tank, which does not aim well yet, and half of the games are
against a history, without which drones forgot how to win against a weak tank (docs/results.md)."""
NARROW = {
    "arena": {"rich": True, "buffer": SEEN_2V2, "rules": {"ray": 0.5}},
    "training": {"opponents": {"kind": "uniform", "past": 0.5}},
}
"""Matches two on two in which both sides rise from even starts (docs/results.md). By HARL-A's ray of 1.5 m tanks that
hold their barrels up cannot be beaten."""


def _galaga(size: str, buffer: int, aim: Mapping[str, Any], fly: Mapping[str, Any]) -> tuple[Stage, ...]:
    """Return the stages in which tank and drone learn alone, with the observations of the game of that size.

    `buffer` numbers behind them are zero until the match; `aim` and `fly` say when the stages end.
    """
    seen = {"arena": {"buffer": buffer}}
    return tuple(
        Stage(name, merged(_stage(name, f"galaga-{name}-{size}", **budget).settings, seen))
        for name, budget in (("aim", aim), ("fly", fly))
    )
