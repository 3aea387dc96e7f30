"""Arenas described for people: one row of a list, and everything about one of them, as plain values.

A sheet is read from the arena itself and from its settings, so pages and tables made from it stay up to date.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING

from arenas.description import AgentOutline, Legend, Outline, Part, describe_team, total_size, with_indices
from league.config.schema import notes

if TYPE_CHECKING:
    from arenas.arena import Arena, Settings

Row = dict[str, object]
PICTURES = "docs/pictures/arenas"


@dataclass(frozen=True)
class Role:
    """Agents of one kind with the same observations."""

    kind: str
    agents: tuple[str, ...]
    observation: tuple[Part, ...]
    action: tuple[Part, ...]


@dataclass(frozen=True)
class Sheet:
    """All about one arena."""

    name: str
    outline: Outline
    roles: tuple[Role, ...]
    legend: Legend
    scripts: Mapping[str, tuple[str, ...]]  # team -> scripts that all its robots know
    privileged: tuple[Part, ...]  # further input of critics; empty if there is none
    settings: "Settings"

    @property
    def page(self) -> str:
        """The file of its page; empty if it has none."""
        return f"docs/arenas/{self.outline.page}.md" if self.outline.page else ""

    @property
    def picture(self) -> str:
        """The file of its picture, a moment of a match between scripts; empty if it has none, as your own arenas."""
        return f"{PICTURES}/{self.name}.webp" if self.outline.page and ":" not in self.name else ""


def outline(settings: "Settings", built: "Arena | None" = None) -> Outline:
    """Return an arena's outline, from its settings if they give it, otherwise from the built arena."""
    outline = getattr(settings, "outline", None)
    if outline is not None:
        return outline()
    arena = built or settings.build(engine="c", threads=1)
    teams = {
        team.name: tuple(AgentOutline(a.kind, a.observation_size, a.action_size) for a in team.agents)
        for team in arena.teams
    }
    return Outline((type(arena).__doc__ or "").partition("\n")[0], teams, arena.timing)


def sheet(settings: "Settings") -> Sheet:
    """Build an arena and describe it. The arena's own code may raise any exception."""
    arena = settings.build(engine="c", threads=1)
    roles: dict[tuple[str, tuple[Part, ...], tuple[Part, ...]], list[str]] = {}
    for agent in arena.agents:
        sees = arena.observation_parts(agent.name) or (Part("unnamed", agent.observation_size),)
        acts = arena.robots[agent.name].action_parts or (Part("unnamed", agent.action_size),)
        roles.setdefault((agent.kind, sees, acts), []).append(agent.name)
    return Sheet(
        settings.name, outline(settings, arena),
        tuple(Role(kind, tuple(agents), sees, acts) for (kind, sees, acts), agents in roles.items()),
        _worded(arena.legend(), settings), {team.name: arena.playable_scripts(team) for team in arena.teams},
        arena.privileged_parts(), settings,
    )  # fmt: skip


def _worded(legend: Legend, settings: "Settings") -> Legend:
    """Return the legend; terms that it does not describe get the notes of their settings."""
    weights = getattr(settings, "reward", None)
    found = notes(type(weights))[1] if weights is not None else {}

    def words(terms: Mapping[str, str]) -> dict[str, str]:
        weighted = {name: f"{getattr(weights, name):+g} {_flat(found[name])}" for name in terms if name in found}
        return {name: what or weighted.get(name, "") for name, what in terms.items()}

    return replace(legend, rewards=words(legend.rewards), shapings=words(legend.shapings))


def line(name: str, outline: Outline) -> Row:
    """Return an arena as a row of a list."""
    return {
        "arena": name,
        "teams": _teams(outline.teams),
        "decisions_per_second": 1 / outline.timing.decision_interval,
        "episode": outline.timing.episode,
        "sees": ", ".join(_distinct(f"{seat.observation_size}" for seats in outline.teams.values() for seat in seats)),
        "what": outline.what,
    }


def timing(outline: Outline) -> str:
    """Describe an arena's timing in a sentence."""
    t = outline.timing
    per_second, held = _counted(1 / t.decision_interval, "decision"), _counted(t.hold, "control step")
    return (
        f"{per_second} per second, held for {held} of {t.control_interval:g} s each ({t.substeps} × {t.timestep:g} s of"
        f" physics); an episode lasts at most {t.episode:g} s, {_counted(t.decisions, 'decision')}."
    )


def team_rows(found: Sheet) -> list[Row]:
    """Return a row for each team: its robots, and the scripts that can play in their place."""
    return [
        {"team": team, "robots": _robots(seats), "scripts": ", ".join(found.scripts[team]) or "none"}
        for team, seats in found.outline.teams.items()
    ]


def part_rows(parts: Sequence[Part]) -> list[Row]:
    """Return a row for each part of an observation or action, with the positions of its numbers."""
    return [
        {"index": place, "what": part.name, "unit": part.unit, "meaning": part.meaning}
        for place, part in with_indices(parts)
    ]


def term_rows(legend: Legend) -> list[Row]:
    """Return a row for each term and event of the verdicts, with its meaning."""
    kinds = (("reward", legend.rewards), ("shaping", legend.shapings), ("event", legend.events))
    return [{"name": name, "kind": kind, "what": what} for kind, terms in kinds for name, what in terms.items()]


def size(parts: Sequence[Part]) -> str:
    """Return the number of numbers in the parts, as text."""
    return _counted(total_size(parts), "number")


def as_json(found: Sheet) -> dict[str, object]:
    """Return a sheet as plain values for JSON."""
    t = found.outline.timing
    return {
        "name": found.name, "what": found.outline.what, "page": found.page, "picture": found.picture,
        "teams": {team: [seat.kind for seat in seats] for team, seats in found.outline.teams.items()},
        "scripts": {team: list(names) for team, names in found.scripts.items()},
        "timing": {**asdict(t), "decision_interval": t.decision_interval, "decisions": t.decisions},
        "roles": [
            {
                "kind": role.kind, "agents": list(role.agents),
                "observation": [{"index": i, **part._asdict()} for i, part in with_indices(role.observation)],
                "action": [{"index": i, **part._asdict()} for i, part in with_indices(role.action)],
            }
            for role in found.roles
        ],
        "privileged": [{"index": i, **part._asdict()} for i, part in with_indices(found.privileged)],
        **asdict(found.legend),
        "settings": asdict(found.settings),
    }  # fmt: skip


def _teams(teams: Mapping[str, Sequence[AgentOutline]]) -> str:
    """Describe teams and their rosters in a few words."""
    rosters = [_robots(seats) for seats in teams.values()]
    if len(rosters) > 1 and len(set(rosters)) == 1:
        return f"{' and '.join(teams)}: {rosters[0]} each"
    return ", ".join(f"{team}: {robots}" for team, robots in zip(teams, rosters, strict=True))


def _flat(note: str) -> str:
    """Return a note in a form that can end a sentence."""
    return (note[:1].lower() + " ".join(note[1:].split())).removesuffix(".")


def _robots(seats: Iterable[AgentOutline]) -> str:
    return describe_team(seat.kind for seat in seats)


def _counted(count: float, what: str) -> str:
    return f"{count:,g} {what}{'' if count == 1 else 's'}"


def _distinct(words: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(words))
