"""Whether what an arena says about itself, `arenas.about`, is what it does."""

from arenas.about import Part, Seat, numbers
from arenas.arena import Arena
from arenas.trial import Trial


def told(trial: Trial, settings: object = None) -> str:
    """What an arena, its robots or the settings that it was built from say wrongly about it, or nothing.

    Nothing need be said; what is said must be whole.
    """
    return _parts(trial.arena) or _legend(trial) or _outline(trial.arena, settings)


def _parts(arena: Arena) -> str:
    for agent in arena.agents:
        robot = arena.robots[agent.name]
        for what, parts, size in (
            (f"observation_parts of {agent.name}", arena.observation_parts(agent.name), agent.observation_size),
            (f"proprioception_parts of {agent.kind}", robot.proprioception_parts, robot.feeling),
            (f"action_parts of {agent.kind}", robot.action_parts, agent.action_size),
        ):
            problem = _wrong(parts, size)
            if problem:
                return f"{what} {problem}"
    problem = _wrong(arena.privileged_parts(), arena.privileged_size)
    return f"privileged_parts {problem}" if problem else ""


def _wrong(parts: tuple[Part, ...], size: int) -> str:
    """What is wrong with the parts of `size` numbers, or nothing."""
    if parts and numbers(parts) != size:
        return f"have {numbers(parts)} numbers, there are {size}"
    names = [part.name for part in parts]
    bad = [name for name in names if not name or names.count(name) > 1]
    if bad:
        return f"need names that differ: {bad[0]!r}"
    empty = [part.name for part in parts if part.size < 1]
    return f"say nothing with {empty[0]}, which has no numbers" if empty else ""


def _legend(trial: Trial) -> str:
    legend, verdict = trial.arena.legend(), trial.first.verdict
    pairs = (
        ("rewards", legend.rewards, verdict.rewards),
        ("shapings", legend.shapings, verdict.shapings),
        ("events", legend.events, verdict.events),
    )
    if not (legend.score or any(words for _, words, _ in pairs)):
        return ""
    for what, words, terms in pairs:
        if set(words) != set(terms):
            return f"the legend tells of {what} {sorted(words)}, the verdict has {sorted(terms)}"
    return ""


def _outline(arena: Arena, settings: object) -> str:
    outline = getattr(settings, "outline", None)
    if outline is None:
        return ""
    said = outline()
    teams = {
        team.name: tuple(Seat(a.kind, a.observation_size, a.action_size) for a in team.agents) for team in arena.teams
    }
    if {name: tuple(seats) for name, seats in said.teams.items()} != teams:
        return f"the settings' outline has the teams {dict(said.teams)}, the arena {teams}"
    return "" if said.timing == arena.timing else f"the settings' outline has {said.timing}, the arena {arena.timing}"
