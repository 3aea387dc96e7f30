"""Leagues that come ready: each a configuration to start from, by name."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from agents.settings import Architecture, HappoConfig
from league.config.experiment import Config, default
from league.config.schema import ConfigError
from league.config.sections import Budget, PlayerSettings
from league.config.stages import Stage
from matchmaking.opponents import Opponents
from matchmaking.roles import Role
from matchmaking.schedule import Schedule


def quickstart() -> Config:
    """2v2 rovers that learn to push each other out of a shrinking ring: five minutes on two cores, then ratings."""
    config = default()
    return replace(config, league="quickstart", budget=Budget(train="5m", rate="3m"))


def duel() -> Config:
    """1v1 rovers: twice as fast to simulate, and flat after half a minute."""
    config = default("sumo-1v1")
    return replace(config, league="duel", budget=Budget(train="2m", rate="1m"))


def selfplay() -> Config:
    """The quick start against the opponents as they are now."""
    return _versus("selfplay", Opponents("latest"))


def delta_uniform() -> Config:
    """The quick start against the newer half of the history (Bansal et al. 2018)."""
    return _versus("delta-uniform", Opponents("delta_uniform", delta=0.5))


def openai_five() -> Config:
    """The quick start by OpenAI Five's rule (Berner et al. 2019): a fifth of the games against the past, by quality."""
    return _versus("openai-five", Opponents("openai_five"))


def psro() -> Config:
    """The quick start against the Nash mixture of the payoff table (PSRO, Lanctot et al. 2017).

    Both teams go on from where they are, instead of from fresh policies as there. What is never rated counts as even,
    so matches get a quarter of the time.
    """
    config = _versus("psro", Opponents("nash"))
    return replace(config, rating=replace(config.rating, share=0.25))


def leapfrog() -> Config:
    """The quick start by turns: who surely scores 70 % hands over, after 50 iterations at the latest."""
    config = _versus("leapfrog", Opponents("latest"))
    schedule = Schedule("leapfrog", period=50, until_score=0.7)
    return replace(config, training=replace(config.training, schedule=schedule))


def alphastar() -> Config:
    """AlphaStar's league (Vinyals et al. 2019) in the quick start's arena: a main player, a main exploiter and a league
    exploiter for each team.

    There 3 main and 6 league exploiters hunt 3 main players; here a league exploiter fewer for each. A life lasts for
    billions of steps there; here for one or half a minute of two cores, and a main player is frozen every 20 seconds.
    Each pair of the three learns for five minutes, one after the other where there is one process that trains.
    """
    config = _versus("alphastar", Opponents("alphastar"))
    players = tuple(
        PlayerSettings(team, f"{team}{ending}", role, group)
        for group, ending, role in (
            ("main", "", "main"),
            ("main-exploiters", "-main-exploiter", "main_exploiter"),
            ("league-exploiters", "-league-exploiter", "league_exploiter"),
        )
        for team in ("blue", "red")
    )
    roles = (
        Role("main", timeout=100_000),
        Role("main_exploiter", timeout=300_000),
        Role("league_exploiter", timeout=150_000),
    )
    return replace(config, players=players, roles=roles)


def _versus(name: str, opponents: Opponents) -> Config:
    """The quick start with another rule for opponents."""
    config = quickstart()
    return replace(config, league=name, training=replace(config.training, opponents=opponents))


def harl_a() -> Config:
    """HARL-A's table of settings (Peterson et al., 2025) in its sumo of 2v2 rovers; for a GPU.

    5,000 worlds × 200 decisions an iteration, HAPPO, and the leapfrog that all its training jobs pass, in turns of 50
    million environment steps, 10 billion in all. (A script for these rovers, which its code has left behind, has turns
    of 100 million and ends after 1 billion.) Galaga has 10,000 worlds there. Its jobs start from policies of a
    curriculum, this preset from fresh ones. What else differs:

    - It counts at the start of an iteration, so its first turn is an iteration shorter than the others; ours is not.
    - Its value normaliser has the deviation 0.1 before it has seen a return, ours 1: in the first update's advantages.
    - It standardises advantages by the unbiased deviation, ours by the biased one: half a millionth of it here.
    - Its first episodes begin with random clocks and end in timeouts that cost; ours are cut, and bootstrap.
    - It replaces observations that are not finite by numbers and goes on; ours makes such episodes void.
    - Its arenas' defects are mended (`arena.rules.defects` brings them back), physics is MuJoCo's instead of PhysX's,
      and the rovers' masses are ours, since theirs are not published.
    - Random numbers are others, with the same seed, 1. Snapshots and ratings are ours, and change nothing learnt.
    """
    config = default("sumo-2v2-leatherback")
    learner = HappoConfig(
        Architecture((128, 128), "relu", layer_norm=True), lr=5e-4, critic_lr=5e-4, gamma=0.99, lam=0.95, clip=0.2,
        entropy=0.01, epochs=5, minibatches=1, max_grad_norm=10.0, huber_delta=10.0, initial_std=0.36553,
        fixed_order=True,
    )  # fmt: skip
    training = replace(
        config.training, worlds=5000, rollout=200, schedule=Schedule("leapfrog", period_steps=50_000_000),
        shaping_steps=0,
    )  # fmt: skip
    budget = Budget(steps=10_000_000_000)
    return replace(config, league="harl_a", learner=learner, training=training, budget=budget)


def by_team() -> Config:
    """HARL-A's sumo of unlike teams, from the first step to the matches: two ANYmals against two Leatherbacks."""
    return _ladder("sumo-by-team", *SUMO)


def within_team() -> Config:
    """HARL-A's sumo of unlike team-mates, from the first step to the matches: an ANYmal and a Leatherback each."""
    return _ladder("sumo-within-team", *SUMO)


def soccer_1v1() -> Config:
    """HARL-A's soccer of one ANYmal against one Leatherback, from the first step to the matches."""
    return _ladder("soccer-1v1", *SOCCER, match={"arena": {"rules": FREE}})


def soccer_2v2() -> Config:
    """HARL-A's soccer of two ANYmals against two Leatherbacks, from the first step to the matches."""
    return _ladder("soccer-2v2", *SOCCER, match={"arena": {"rules": FREE}})


def galaga_1v1() -> Config:
    """3D Galaga of one tank and one drone: each learns alone first, to aim and to fly."""
    return _ladder("galaga-1v1", *_galaga("1v1"))


def galaga_2v2() -> Config:
    """3D Galaga of two tanks and two drones within walls, by the same stages."""
    return _ladder("galaga-2v2", *_galaga("2v2"))


def _ladder(arena: str, *stages: Stage, match: Mapping[str, Any] | None = None) -> Config:
    """HARL-A's stages, and then its matches, with settings of their own where they have such.

    Budgets are for a GPU; `--steps` bounds each of them. With this learner an ANYmal walks after 2 million
    steps (docs/arenas/anymal-walk.md).
    """
    config = default(arena)
    learner = HappoConfig(
        Architecture((128, 128, 128), "elu"), lr=1e-3, critic_lr=1e-3, gamma=0.99, initial_std=0.6,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout=24, shaping_steps=50_000_000, snapshots_per_doubling=4)
    last = Stage("match", {"budget": {"steps": 500_000_000}, **(match or {})})
    budget = Budget(rate="5m")
    return replace(config, league=arena, learner=learner, training=training, budget=budget, stages=(*stages, last))


def _stage(name: str, arena: str, **budget: Any) -> Stage:
    return Stage(name, {"arena": {"name": arena}, "budget": budget})


def _scoring(arena: str, ease: float, rules: Mapping[str, Any], **budget: Any) -> Stage:
    """A robot learns to score by what made it do so (docs/results.md); with `ease` it begins on the way to the goal.

    Hints are strong and fade by success, nothing is paid for standing anywhere, the view is long and steps are careful.
    """
    reward = {"approach": 1.0, "push": 4.0, "near": 0.0, "ball": 0.0}
    name = arena.removeprefix("soccer-") + ("-easy" if ease else "")
    settings = {
        "arena": {"name": arena, "reward": reward, "rules": {**rules, "ease": ease}}, "budget": budget,
        "learner": {"lr": 3e-4, "kl_step": 0.01, "gamma": 0.997},
        "training": {"shaping_until": 0.9, "shaping_steps": "none"},
    }  # fmt: skip
    return Stage(name, settings)


SUMO = (
    _stage("walk", "anymal-walk", success=0.9, steps=200_000_000),
    _stage("push-anymal", "block-push-anymal", steps=100_000_000),
    _stage("push-leatherback", "block-push-leatherback", steps=50_000_000),
)
FREE = {"drive_scale": 40.0, "steer_scale": 0.5}
"""Of a Leatherback in soccer: full throttle is 1.25 units of its action and not 5, which exploring never reaches."""
SOCCER = (
    _stage("walk", "soccer-walk", success=0.9, steps=200_000_000),
    _stage("ball", "soccer-ball", success=0.9, steps=100_000_000),
    _scoring("soccer-score", 1.0, {}, success=0.7, steps=25_000_000),
    _scoring("soccer-score", 0.0, {}, success=0.7, steps=200_000_000),
    _scoring("soccer-score-leatherback", 1.0, FREE, success=0.7, steps=25_000_000),
    _scoring("soccer-score-leatherback", 0.0, FREE, success=0.7, steps=100_000_000),
)


def _galaga(size: str) -> tuple[Stage, ...]:
    """Tank and drone alone, with the observations of that game."""
    return (
        _stage("aim", f"galaga-aim-{size}", success=0.9, steps=50_000_000),
        _stage("fly", f"galaga-fly-{size}", success=0.9, steps=200_000_000),
    )


PRESETS: Mapping[str, Callable[[], Config]] = {
    "quickstart": quickstart, "duel": duel, "selfplay": selfplay, "leapfrog": leapfrog, "alphastar": alphastar,
    "psro": psro, "openai-five": openai_five, "delta-uniform": delta_uniform, "harl_a": harl_a,
    "sumo-by-team": by_team, "sumo-within-team": within_team,
    "soccer-1v1": soccer_1v1, "soccer-2v2": soccer_2v2, "galaga-1v1": galaga_1v1, "galaga-2v2": galaga_2v2,
}  # fmt: skip


def preset(name: str) -> Config:
    """A preset by name. Raises ConfigError, one line with what exists, for an unknown one."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(("preset",), f"unknown preset {name!r}: {hint}(presets: {', '.join(PRESETS)})")
    return PRESETS[name]()
