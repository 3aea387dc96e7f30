"""Skills of a team: frozen policies through which its agents act, each wired to what the agent observes here.

A skill sees what it saw where it learnt. Each part of that observation comes from the part of the same name and size in
the agent's own observation, unless it is commanded; a command may name another part for it. A part that is neither
keeps its mean, if it never moved while the skill learnt; otherwise the skill cannot act here.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from agents.policy.constant_inputs import CONSTANT, silence_constant_inputs
from agents.policy.skill_arrays import PREFIX, Skill, choice_size, is_over_skills, skill_arrays, strategy_of
from agents.settings import COMMAND, SkillSettings
from arenas.description import Part, first_numbers
from arenas.state import TeamSpec
from league.snapshots import policy_file
from league.snapshots.transfer.home_arena import home_team

if TYPE_CHECKING:
    from arenas.arena import Arena


SET = (".every", ".blend", ".reach", ".source", ".target")
"""Ends of the names of arrays that follow from settings; others are weights."""


class SkillError(ValueError):
    """A skill that no agent of the arena can act through: one line with the setting's name before a colon."""


class Teacher(NamedTuple):
    """An agent of a frozen policy, as it learnt."""

    named: str  # as in the settings
    kind: str  # of robot
    actions: int
    network: Mapping[str, np.ndarray]
    parts: tuple[Part, ...]  # of its observation
    interval: float  # s between its decisions
    config_hash: str  # of the arena in which it learnt


class Command(NamedTuple):
    """A part of a skill's observation that is commanded."""

    part: str
    size: int | None  # how many of its first numbers; None: all
    here: str  # the part of the agent's own observation that the skill sees in its place

    @classmethod
    def parse(cls, text: str) -> "Command":
        """Return the command that a text of the settings means, which `agents.settings.check_commands` has checked."""
        found = COMMAND.fullmatch(text)
        assert found
        part, size, here = found.groups()
        return cls(part, int(size) if size else None, here or part)


class TeamSkills:
    """The skills of a team: the arrays that join each agent's strategy, and the team as its learner sees it.

    `arrays` has one dict for each agent, with the names of `agents.policy.skill_arrays`. `team` is the arena's team, in
    which agents act with commands.
    """

    def __init__(self, team: TeamSpec, arrays: Sequence[Mapping[str, np.ndarray]], choices: Sequence[int]):
        self.arrays = tuple(arrays)
        sized = zip(team.agents, choices, strict=True)
        self.team = replace(team, agents=tuple(replace(agent, action_size=size) for agent, size in sized))

    def joined(self, policies: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return the agents' policies over skills, given their strategies. Raises ValueError for recurrent ones."""
        if any("gru.weight_hh" in policy for policy in policies):
            raise ValueError("a strategy over skills remembers nothing but its command, and this one is recurrent")
        return [{**policy, **own} for policy, own in zip(policies, self.arrays, strict=True)]

    def state(self) -> dict[str, np.ndarray]:
        """Return the arrays as part of a checkpoint, so that a league goes on with the skills that it began with."""
        return {f"{PREFIX}{i}/{name}": array for i, own in enumerate(self.arrays) for name, array in own.items()}

    def load(self, state: Mapping[str, np.ndarray]) -> None:
        """Take over the skills of a checkpoint. Raises ValueError for those of other settings."""
        found: list[dict[str, np.ndarray]] = []
        for i, own in enumerate(self.arrays):
            other = {name: state.get(f"{PREFIX}{i}/{name}") for name in own}
            for name, array in own.items():
                if (given := other[name]) is None or given.shape != array.shape:
                    raise ValueError("the checkpoint has other skills than learner.skill.policies names")
                if name.endswith(SET) and not np.array_equal(given, array):
                    raise ValueError(f"learner.skill is not that of the checkpoint: {name} differs")
            found.append({name: np.asarray(given) for name, given in other.items()})
        self.arrays = tuple(found)


def check_checkpoint(skills: TeamSkills | None, state: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if a checkpoint's player acted over other skills than one with these, or over some or none."""
    if skills is not None:
        skills.load(state)
    elif any(name.startswith(PREFIX) for name in state):
        raise ValueError("the checkpoint is of a player over skills; name them in learner.skill")


def team_skills(settings: SkillSettings, arena: "Arena", team: TeamSpec) -> TeamSkills | None:
    """Return the skills of a team, None if no agent of it has one. Agents without any hold their actions alike.

    Raises SkillError, one line, for a skill that cannot act here, StorageError for a file without a policy.
    """
    kinds = {agent.kind for agent in team.agents}
    teachers = [(each, part) for each, part in _teachers(settings) if each[0].kind in kinds]
    if not teachers:
        return None
    arrays, choices, seen = [], [], Counter[str]()
    for agent in team.agents:
        own = [(each[seen[agent.kind] % len(each)], part) for each, part in teachers if each[0].kind == agent.kind]
        seen[agent.kind] += 1
        command = sum(_commanded(teacher, part)[1] for teacher, part in own)
        parts, offset, skills = arena.observation_parts(agent.name), 0, []
        for teacher, part in own:
            _check_fit(teacher, arena, agent.action_size)
            skill, size = _wired(teacher, part, parts, settings.mode, (offset, command), arena.name)
            if teacher.config_hash != arena.config_hash:
                skill = skill._replace(network=silence_constant_inputs(skill.network))
            skills.append(skill)
            offset += size
        arrays.append(skill_arrays(skills, settings.every, settings.reach, settings.combine == "blend"))
        choices.append(choice_size(command, len(skills)) or agent.action_size)
    return TeamSkills(team, arrays, choices)


def check_skills(settings: SkillSettings, arena: "Arena") -> None:
    """Raise SkillError or StorageError for skills that cannot act in an arena, or that nobody in it has."""
    kinds = {agent.kind for agent in arena.agents}
    for teachers, _ in _teachers(settings):
        if teachers[0].kind not in kinds:
            raise SkillError(
                f"policies: {teachers[0].named} moves robots of kind {teachers[0].kind}, and {arena.name} has"
                f" {', '.join(sorted(kinds))}"
            )
    for team in arena.teams:
        team_skills(settings, arena, team)


def _teachers(settings: SkillSettings) -> Iterator[tuple[Sequence[Teacher], Command]]:
    """Yield the agents of each policy, all of one kind of robot, with what is commanded."""
    if settings.policies and not settings.command:
        raise SkillError("command: name the part of the skills' observations that is commanded")
    parts = settings.command * (1 if len(settings.command) == len(settings.policies) else len(settings.policies))
    for named, text in zip(settings.policies, parts, strict=True):
        agents = _agents_of(named)
        for kind in dict.fromkeys(agent.kind for agent in agents):
            yield [agent for agent in agents if agent.kind == kind], Command.parse(text)


@cache
def _agents_of(named: str) -> tuple[Teacher, ...]:
    """Return the agents of a frozen policy. Its arena is built to name the parts of their observations: seconds."""
    policy = policy_file.read(policy_file.find(named))
    about = policy.about
    try:
        home = home_team(about["settings"], about["roster"])
    except ValueError as error:
        raise SkillError(f"policies: {named}: {error}") from None
    found = []
    for i, agent in enumerate(home.agents):
        own = {k.partition("/")[2]: v for k, v in policy.arrays.items() if k.startswith(f"{i}/")}
        if "gru.weight_hh" in own or is_over_skills(own):
            raise SkillError(f"policies: {named} remembers what it saw, or is over skills; a skill does neither")
        if not agent.parts:
            raise SkillError(f"policies: {named}: {home.arena}, where it learnt, does not name what is observed")
        about_it = agent.kind, agent.action_size, strategy_of(own), agent.parts, home.interval
        found.append(Teacher(named, *about_it, (about["arena"] or {}).get("config_hash", home.config_hash)))
    return tuple(found)


def _check_fit(teacher: Teacher, arena: "Arena", actions: int) -> None:
    """Raise SkillError for a skill with other actions, or one that decides at another rate, than the arena's robots."""
    if teacher.actions != actions:
        raise SkillError(
            f"policies: {teacher.named} acts with {teacher.actions} numbers, and {teacher.kind} in {arena.name} with"
            f" {actions}"
        )
    here = arena.timing.decision_interval
    if abs(here - teacher.interval) > 1e-6:
        raise SkillError(
            f"policies: {teacher.named} decides every {teacher.interval:g} s, and {arena.name} every {here:g} s; give"
            " the arena the same rate (arena.rules.decide_every, where it has one)"
        )


def _commanded(teacher: Teacher, command: Command) -> tuple[int, int]:
    """Return the first place of a commanded part in a skill's observation, and how many numbers are commanded."""
    first = 0
    for part in teacher.parts:
        if part.name == command.part:
            size = command.size or part.size
            if size > part.size:
                raise SkillError(
                    f"command: '{part.name}:{size}': {part.name} of {teacher.named} has {part.size} numbers only"
                )
            return first, size
        first += part.size
    raise SkillError(f"command: {teacher.named} observes no {command.part!r}; it observes {_names(teacher.parts)}")


def _wired(
    teacher: Teacher, command: Command, own: Sequence[Part], mode: str, commands: tuple[int, int], arena: str
) -> tuple[Skill, int]:
    """Return a skill that sees what an agent observes, `own`, and the number of its commands.

    `commands` are the place of its first command among those of all skills of the agent, and their number.
    """
    at, size = _commanded(teacher, command)
    places, nowhere = first_numbers(own), sum(part.size for part in own)
    offset, nothing = commands
    total = sum(part.size for part in teacher.parts)
    source, target = np.full(total, nowhere, np.int32), np.full(total, nothing, np.int32)
    fill = np.zeros(total, np.float32)
    mean, var = (np.asarray(teacher.network[f"trunk.observation_{of}"]) for of in ("mean", "var"))
    first, met = 0, Counter[tuple[str, int]]()
    for part in teacher.parts:
        inside = np.arange(first, first + part.size)
        chosen = inside[(inside >= at) & (inside < at + size)]
        rest = np.setdiff1d(inside, chosen)
        named = command.here if len(chosen) else part.name
        before = met[named, part.size] if named == part.name else 0
        here = places.get((named, part.size, before))
        met[part.name, part.size] += 1
        target[chosen] = offset + chosen - at
        if here is not None:
            source[inside] = here + np.arange(part.size)
        if mode == "replace":
            source[chosen] = nowhere
        missing = rest if mode == "replace" else inside
        if here is None and named != part.name:
            raise SkillError(
                f"command: {arena} shows robots of kind {teacher.kind} no {named!r} of {part.size} numbers; it shows"
                f" {_names(each for each in own if each.size == part.size) or 'no part of this size'}"
            )
        if here is None and len(missing):
            _check_missing(teacher, part, arena, mode, len(chosen), bool((var[missing] >= CONSTANT).any()))
            fill[missing] = mean[missing]
        first += part.size
    return Skill(teacher.network, source, target, fill), size


def _check_missing(teacher: Teacher, part: Part, arena: str, mode: str, commanded: int, moved: bool) -> None:
    """Raise SkillError if a skill needs a part that an agent does not observe here."""
    if commanded and mode == "shift":
        raise SkillError(
            f"mode: {arena} shows robots of kind {teacher.kind} no {part.name!r} of {part.size} numbers, to which a"
            f' command could be added; name another part, "{part.name}=HERE", or use "replace"'
        )
    if moved and not commanded:
        raise SkillError(
            f"policies: {teacher.named} needs {part.name!r} ({part.size} numbers), which {arena} does not show robots"
            f" of kind {teacher.kind}, and which is not commanded"
        )


def _names(parts: Iterable[Part]) -> str:
    return ", ".join(dict.fromkeys(part.name for part in parts))
