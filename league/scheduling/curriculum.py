"""Progress of a curriculum, read from the store: the current stage, and the rules that end it.

Each stage is a league of its own, `main.walk` for the stage `walk` of `main`. The current stage is that of the last
league that exists, so a curriculum continues at the same place on any machine.
"""

from collections.abc import Sequence
from typing import NamedTuple

from league.config import experiment as configuration
from league.config.experiment import Config
from league.scheduling.episode_lengths import averaged_iterations
from league.scheduling.training_progress import learnt_enough, why
from league.state.curriculum_stage import course
from league.state.league_state import LeagueState
from storage.store import Store


class StageProgress(NamedTuple):
    """A stage of a curriculum and the state of its league."""

    name: str
    config: Config
    state: LeagueState
    ahead: int  # its distance from the current stage: negative before it, 0 for itself, positive after it


def reached(store: Store, config: Config) -> int:
    """Return the number of the current stage: the last one that has begun, or the first."""
    names = {each.name for each in store.leagues()}
    return max((n for n in range(len(config.stages)) if configuration.stage(config, n).league in names), default=0)


def ended(config: Config, league_state: LeagueState) -> str | None:
    """Describe the event that ended a stage; None for a stage that has not ended, even if it makes no progress."""
    found = []
    for group, players in league_state.groups.items():
        seconds, steps = league_state.spent(group, config.training.schedule)
        if learnt_enough(config, league_state, players):
            reasons = [why(config.budget, config.rating.episodes_per_pair, league_state, player) for player in players]
            found.append(", ".join(filter(None, reasons)) or "the reward asked for was reached")
        elif config.budget.spent(seconds, steps):
            found.append(f"{steps:,} steps of {_budget(config)}")
        else:
            return None
    return ", ".join(dict.fromkeys(found)) or None


def stage_state(store: Store, config: Config) -> LeagueState:
    """Return the state of a stage's league; empty for a stage that has not begun."""
    if config.league not in {league.name for league in store.leagues()}:
        return LeagueState()
    return LeagueState.of(store, config.league, recent=averaged_iterations(config))


def read_stages(store: Store, league: str) -> list[StageProgress]:
    """Return the stages of a curriculum; `league` is the curriculum itself or one of its stages."""
    found = course(store, league)
    if found is None:
        return []
    config = configuration.loads(store.league(found.root).config)
    stages = [configuration.stage(config, number) for number in range(len(found.stages))]
    now = reached(store, config)
    return [
        StageProgress(name, stage, stage_state(store, stage), number - now)
        for number, (name, stage) in enumerate(zip(found.stages, stages, strict=True))
    ]


def report(stages: Sequence[StageProgress]) -> list[str]:
    """Describe each stage of a curriculum in a line, with the event that ended it or will end it."""
    lines = []
    for number, (name, config, state, ahead) in enumerate(stages, 1):
        why = ended(config, state)
        end = "waits" if ahead > 0 else f"has ended: {why}" if why else f"ends {until(config)}"
        lines.append(f"{number}. {name}{', under way' if not ahead and not why else ''}: {end}")
    return lines


def until(config: Config) -> str:
    """Describe the rules that will end a stage."""
    budget, rules = config.budget, []
    if budget.success is not None:
        rules.append(f"when {budget.success:.0%} succeed, by the lower end of the interval")
    if budget.score is not None:
        opponents = ", ".join(budget.against) or "initial"
        rules.append(f"when each scores {budget.score:.0%} against {opponents}, by the lower end of the interval")
    if budget.plateau is not None:
        rules.append(f"when the last {budget.plateau} snapshots are no better than one before them")
    if budget.reward is not None:
        rules.append(f"when the reward per episode is {budget.reward:g} over {averaged_iterations(config)} iterations")
    if budget.steps is not None or budget.training_time is not None:
        rules.append(f"after {_budget(config)}")
    return " or ".join(rules) or "never"


def _budget(config: Config) -> str:
    steps, train = config.budget.steps, config.budget.training_time
    rules = [f"{steps:,} steps"] if steps is not None else []
    return " or ".join([*rules, f"{train} of training"] if train is not None else rules)
