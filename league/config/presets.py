"""Presets: named configurations to start from."""

import difflib
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from agents.settings import Architecture, HappoConfig
from league.config.experiment import Config, default
from league.config.schema import ConfigError
from league.config.sections import Budget, PlayerSettings
from league.config.stages import Stage
from matchmaking.opponents import Opponents
from matchmaking.roles import Role
from matchmaking.schedule import Schedule

if TYPE_CHECKING:
    from arenas.games.disturbance import DisturbanceSettings


def quickstart() -> Config:
    """2v2 rovers that learn to push each other out of a shrinking ring: three minutes on two cores, then ratings."""
    config = default()
    return replace(config, league="quickstart", budget=Budget(training_time="3m", rating_time="1m"))


def duel() -> Config:
    """1v1 rovers: twice as fast to simulate, and flat after half a minute."""
    config = default("sumo-1v1")
    return replace(config, league="duel", budget=Budget(training_time="2m", rating_time="1m"))


def tag() -> Config:
    """Tag of three pucks, free for all: two minutes on two cores, then ratings."""
    config = default("tag")
    return replace(config, league="tag", budget=Budget(training_time="2m", rating_time="1m"))


def selfplay() -> Config:
    """Quick start against the opponents as they are now."""
    return _versus("selfplay", Opponents("latest"))


def delta_uniform() -> Config:
    """Quick start against the newer half of the history (Bansal et al. 2018)."""
    return _versus("delta-uniform", Opponents("delta_uniform", delta=0.5))


def openai_five() -> Config:
    """Quick start by OpenAI Five's rule (Berner et al. 2019): a fifth of the games against the past."""
    return _versus("openai-five", Opponents("openai_five"))


def psro() -> Config:
    """Quick start against the Nash mixture of the payoff table (PSRO, Lanctot et al. 2017).

    Both teams continue from their current policies; in PSRO each response starts from a fresh policy. Unrated pairs
    count as even, so matches get a quarter of the time.
    """
    config = _versus("psro", Opponents("nash"))
    return replace(config, rating=replace(config.rating, share=0.25))


def leapfrog() -> Config:
    """Quick start by turns: a team hands over once it surely scores 70 %, after 50 iterations at the latest."""
    config = _versus("leapfrog", Opponents("latest"))
    schedule = Schedule("leapfrog", period=50, until_score=0.7)
    return replace(config, training=replace(config.training, schedule=schedule))


def alphastar() -> Config:
    """AlphaStar's league (Vinyals et al. 2019) in the quick start's arena: a main player, a main exploiter and a league
    exploiter for each team.

    AlphaStar has 3 main and 6 league exploiters for 3 main players; this preset has one league exploiter fewer for each
    main player. A generation lasts billions of steps there; here it lasts one minute or half a minute on two cores, and
    a main player is frozen every 20 seconds. Each of the three pairs learns for five minutes, one pair after the other
    if a single process trains.
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
    """Quick start with other opponent settings."""
    config = quickstart()
    return replace(config, league=name, training=replace(config.training, opponents=opponents))


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


def hopper_alone() -> Config:
    """Hopper that learns to hop ahead undisturbed, the base line of the next two; for a GPU."""
    return _hopper("hopper-alone", bodies=())


def hopper_adversary() -> Config:
    """Hopper against one adversary that pushes its foot (RARL, Pinto et al. 2017): both learn, by turns."""
    config = _hopper("hopper-adversary")
    training = replace(config.training, schedule=Schedule("leapfrog", period=25))
    budget = replace(config.budget, steps=200_000_000)  # of both in turn, so the walker has as many as in the others
    return replace(config, training=training, budget=budget)


def hopper_adversaries() -> Config:
    """Hopper against the history of four adversaries (Vinitsky et al. 2020): one learns beside it, three against its
    newest snapshot.
    """
    config = _hopper("hopper-adversaries")
    natures = [PlayerSettings("nature", f"nature-{i}" if i > 1 else "nature", "adversary") for i in range(1, 5)]
    roles = (
        Role("main", timeout=2_000_000, opponents=Opponents("delta_uniform", delta=0.5, past=0.75)),
        Role("adversary", timeout=2_000_000, opponents=Opponents("latest")),
    )
    return replace(config, players=(PlayerSettings("blue"), *natures), roles=roles)


def _hopper(name: str, **arena: Any) -> Config:
    """Return a league of a hopper against forces on its foot of at most a fifth of its weight; the walker's budget is
    the same in all.
    """
    config = default("disturbance")
    settings = cast("DisturbanceSettings", config.arena)
    rules = replace(settings.rules, weight_share=0.2)
    settings = replace(settings, **{"blue": ("hopper",), "bodies": ("foot",), "rules": rules, **arena})
    learner = HappoConfig(
        Architecture((128, 128), "elu"), lr=5e-4, critic_lr=1e-3, gamma=0.99, initial_std=0.5, desired_kl=0.01,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, snapshots_per_doubling=2)
    budget = Budget(steps=100_000_000, rating_time="2m")
    return replace(config, league=name, arena=settings, learner=learner, training=training, budget=budget)


def gate_race() -> Config:
    """Two drones that race through gates and are paid for places alone, as in 2512.11781; for a GPU.

    Its networks and batches are smaller than the paper's (512, 512, 256, 128; 10,240 worlds of 16 decisions). With
    `--arena.teams 1` a drone learns alone, and with `--arena.rules.walls true` there are walls.
    """
    config = default("gate-race")
    learner = HappoConfig(
        Architecture((256, 256, 128), "elu"), lr=3e-4, critic_lr=5e-4, gamma=0.99, initial_std=0.5, desired_kl=0.01,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, snapshots_per_doubling=2)
    budget = Budget(training_time="20m", rating_time="2m")
    return replace(config, league="gate-race", learner=learner, training=training, budget=budget)


def _ladder(arena: str, *stages: Stage, match: Mapping[str, Any] | None = None) -> Config:
    """Return a league of HARL-A's stages and a last stage of matches; `match` has settings of the last stage.

    Budgets are for a GPU; `--steps` bounds each of them. With this learner an ANYmal walks after 2 million steps
    (docs/arenas/anymal-walk.md).
    """
    config = default(arena)
    learner = HappoConfig(
        Architecture((128, 128, 128), "elu"), lr=1e-3, critic_lr=1e-3, gamma=0.99, initial_std=0.6,
        normalise_observations=True,
    )  # fmt: skip
    training = replace(config.training, rollout_length=24, shaping_steps=50_000_000, snapshots_per_doubling=4)
    last = Stage("match", {"budget": {"steps": 500_000_000}, **(match or {})})
    budget = Budget(rating_time="5m")
    return replace(config, league=arena, learner=learner, training=training, budget=budget, stages=(*stages, last))


def _stage(name: str, arena: str, **budget: Any) -> Stage:
    return Stage(name, {"arena": {"name": arena}, "budget": budget})


def _scoring(arena: str, ease: float, rules: Mapping[str, Any], **budget: Any) -> Stage:
    """Return a stage in which a robot learns to score, by settings that succeeded (docs/results.md).

    With `ease` the robot begins on the way to the goal. The dense reward is strong and fades by success, positions
    alone earn nothing, the discount is close to 1 and updates are small.
    """
    reward = {"approach": 1.0, "push": 4.0, "near": 0.0, "ball": 0.0}
    name = arena.removeprefix("soccer-") + ("-easy" if ease else "")
    settings = {
        "arena": {"name": arena, "reward": reward, "rules": {**rules, "ease": ease}}, "budget": budget,
        "learner": {"lr": 3e-4, "desired_kl": 0.01, "gamma": 0.997},
        "training": {"shaping_until": 0.9, "shaping_steps": "none"},
    }  # fmt: skip
    return Stage(name, settings)


SUMO = (
    _stage("walk", "anymal-walk", success=0.9, steps=200_000_000),
    _stage("push-anymal", "block-push-anymal", score=0.8, plateau=6, steps=100_000_000),
    _stage("push-leatherback", "block-push-leatherback", score=0.8, plateau=6, steps=50_000_000),
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
    _scoring("soccer-score-leatherback", 0.0, FREE, success=0.7, steps=100_000_000),
)


def _galaga(size: str) -> tuple[Stage, ...]:
    """Return the stages in which tank and drone learn alone, with the observations of the game of that size."""
    return (
        _stage("aim", f"galaga-aim-{size}", success=0.9, steps=50_000_000),
        _stage("fly", f"galaga-fly-{size}", success=0.9, steps=200_000_000),
    )


PRESETS: Mapping[str, Callable[[], Config]] = {
    "quickstart": quickstart, "duel": duel, "tag": tag, "selfplay": selfplay, "leapfrog": leapfrog,
    "alphastar": alphastar,
    "psro": psro, "openai-five": openai_five, "delta-uniform": delta_uniform, "harl_a": harl_a,
    "sumo-by-team": by_team, "sumo-within-team": within_team,
    "hopper-alone": hopper_alone, "hopper-adversary": hopper_adversary, "hopper-adversaries": hopper_adversaries,
    "soccer-1v1": soccer_1v1, "soccer-2v2": soccer_2v2, "galaga-1v1": galaga_1v1, "galaga-2v2": galaga_2v2,
    "gate-race": gate_race,
}  # fmt: skip


def preset(name: str) -> Config:
    """Return a preset by name. Raises ConfigError, one line with all presets, for an unknown name."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, 1)
        hint = f"did you mean {near[0]}? " if near else ""
        raise ConfigError(
            ("preset",),
            f"unknown preset {name!r}: {hint}(presets: {', '.join(PRESETS)}; `league presets` tells what each is)",
        )
    return PRESETS[name]()
