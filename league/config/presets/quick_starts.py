"""Presets of minutes on two cores: the quick start, and the same game by other opponents and schedules."""

from dataclasses import replace

from agents.settings import Architecture
from league.config.experiment import Config, default
from league.config.sections import Budget, PlayerSettings
from matchmaking.opponents import Opponents
from matchmaking.roles import Role
from matchmaking.schedule import Schedule


def quickstart() -> Config:
    """2v2 rovers that learn to push each other out of a shrinking ring: three minutes on two cores, then ratings.

    Both robots of a team share an actor, by which they are stronger after as many decisions (docs/bench.md, T1).
    """
    config = default()
    learner = replace(config.learner, share_actors=True)
    return replace(config, league="quickstart", learner=learner, budget=Budget(training_time="3m", rating_time="1m"))


def duel() -> Config:
    """1v1 rovers: twice as fast to simulate, and flat after half a minute."""
    config = default("sumo-1v1")
    return replace(config, league="duel", budget=Budget(training_time="2m", rating_time="1m"))


def rovers() -> Config:
    """2v2 rovers as in the quick start, with a larger network and a longer horizon, until stopped; for a GPU.

    Half as many worlds as a GPU has by default and half a rollout bring 2.5 times as many updates a second, and 75 %
    against `pusher` a fifth sooner (docs/results.md).
    """
    config = quickstart()
    learner = replace(config.learner, architecture=Architecture((128, 128)), gamma=0.99)
    training = replace(config.training, worlds=2048, rollout_length=16, snapshots_per_doubling=4)
    return replace(config, league="rovers", learner=learner, training=training, budget=Budget())


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
