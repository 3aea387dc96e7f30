"""A curriculum as the store has it: how far the walk has come, and what ends a stage.

Each stage is a league of its own, `main.walk` for the stage `walk` of `main`. Where the walk stands is where the last
league that exists stands; so whoever picks it up, on whatever machine, goes on there.
"""

from league.config import experiment as configuration
from league.config.experiment import Config
from league.course import course
from league.measures import learnt_enough
from league.plan import spent
from league.standing import Standing
from storage.store import Store


def reached(store: Store, config: Config) -> int:
    """The number of the stage that the walk is at: the last one that has begun, or the first."""
    begun = {each.name for each in store.leagues()}
    return max((n for n in range(len(config.stages)) if configuration.stage(config, n).league in begun), default=0)


def ended(config: Config, standing: Standing) -> str | None:
    """What has ended a stage, in words; None where nothing has, though it may stand still."""
    found = []
    for group, players in standing.groups.items():
        seconds, steps = spent(config, standing, group)
        if learnt_enough(config, standing, players):
            found.append("what it was to learn was reached")
        elif config.budget.spent(seconds, steps):
            found.append(f"{steps:,} steps of {_budget(config)}")
        else:
            return None
    return ", ".join(dict.fromkeys(found)) or None


def standing(store: Store, config: Config) -> Standing:
    """How a stage stands; empty for one that has not begun."""
    if config.league not in {league.name for league in store.leagues()}:
        return Standing()
    return Standing.of(store, config.league, recent=config.budget.window)


def report(store: Store, league: str) -> list[str]:
    """A line for each stage of the curriculum that the league is, or is a stage of: what has ended or will end it."""
    found = course(store, league)
    if found is None:
        return []
    config = configuration.loads(store.league(found.root).config)
    now, lines = reached(store, config), []
    for number, name in enumerate(found.stages):
        own = configuration.stage(config, number)
        why = ended(own, standing(store, own))
        state = "waits" if number > now else f"has ended: {why}" if why else f"ends {until(own)}"
        lines.append(f"{number + 1}. {name}{', under way' if number == now and not why else ''}: {state}")
    return lines


def until(config: Config) -> str:
    """What will end a stage, in words."""
    budget, rules = config.budget, []
    if budget.success is not None:
        rules.append(f"when {budget.success:.0%} succeed, by the lower end of the interval")
    if budget.reward is not None:
        rules.append(f"when the reward per episode is {budget.reward:g} over {budget.window} iterations")
    if budget.steps is not None or budget.train is not None:
        rules.append(f"after {_budget(config)}")
    return " or ".join(rules) or "never"


def _budget(config: Config) -> str:
    steps, train = config.budget.steps, config.budget.train
    told = [f"{steps:,} steps"] if steps is not None else []
    return " or ".join([*told, f"{train} of training"] if train is not None else told)
