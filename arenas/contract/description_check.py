"""Check that an arena's description (`arenas.description`) agrees with the arena."""

from arenas.arena import Arena
from arenas.contract.check_run import CheckRun
from arenas.description import AgentOutline, Part, total_size


def check_description(run: CheckRun, settings: object = None) -> str:
    """Describe the first error in the descriptions of an arena, its robots and its settings; empty if there is none.

    Descriptions are optional, but a description must be complete.
    """
    return _parts(run.arena) or _legend(run) or _outline(run.arena, settings)


def _parts(arena: Arena) -> str:
    for agent in arena.agents:
        robot = arena.robots[agent.name]
        for what, parts, size in (
            (f"observation_parts of {agent.name}", arena.observation_parts(agent.name), agent.observation_size),
            (f"proprioception_parts of {agent.kind}", robot.proprioception_parts, robot.proprioception_size),
            (f"action_parts of {agent.kind}", robot.action_parts, agent.action_size),
        ):
            problem = _wrong(parts, size)
            if problem:
                return f"{what} {problem}"
    problem = _wrong(arena.privileged_parts(), arena.privileged_size)
    return f"privileged_parts {problem}" if problem else ""


def _wrong(parts: tuple[Part, ...], size: int) -> str:
    """Describe the error in the parts of `size` numbers; empty if there is none."""
    if parts and total_size(parts) != size:
        return f"have {total_size(parts)} numbers, there are {size}"
    names = [part.name for part in parts]
    bad = [name for name in names if not name or names.count(name) > 1]
    if bad:
        return f"need unique names: {bad[0]!r}"
    empty = [part.name for part in parts if part.size < 1]
    return f"have the part {empty[0]}, which has no numbers" if empty else ""


def _legend(run: CheckRun) -> str:
    legend, verdict = run.arena.legend(), run.first.verdict
    pairs = (
        ("rewards", legend.rewards, verdict.rewards),
        ("shapings", legend.shapings, verdict.shapings),
        ("events", legend.events, verdict.events),
    )
    if not (legend.score or any(words for _, words, _ in pairs)):
        return ""
    for what, words, terms in pairs:
        if set(words) != set(terms):
            return f"the legend has {what} {sorted(words)}, the verdict has {sorted(terms)}"
    return ""


def _outline(arena: Arena, settings: object) -> str:
    outline = getattr(settings, "outline", None)
    if outline is None:
        return ""
    said = outline()
    added = bool(getattr(settings, "observation_terms", None))  # an outline knows no function in a file

    def known(size: int) -> int:
        return 0 if added else size

    teams = {
        team.name: tuple(AgentOutline(a.kind, known(a.observation_size), a.action_size) for a in team.agents)
        for team in arena.teams
    }
    told = {
        name: tuple(seat._replace(observation_size=known(seat.observation_size)) for seat in seats)
        for name, seats in said.teams.items()
    }
    if told != teams:
        return f"the settings' outline has the teams {dict(said.teams)}, the arena {teams}"
    return "" if said.timing == arena.timing else f"the settings' outline has {said.timing}, the arena {arena.timing}"
