"""Import of a program into a league, as a fixed player for the roster of one of its teams."""

from league.config.schema import ConfigError
from league.queries.query import Open
from league.snapshots.programs import stored
from league.snapshots.programs.kinds import WORDS
from league.snapshots.programs.stored import Program
from storage.errors import UnknownName
from storage.records import Snapshot


def roster_of(league: Open, team: str | None) -> str:
    """Return the roster of a team, by its name, number or one of its players; None: the roster of all teams.

    Raises UnknownName for an unknown team, ConfigError if the teams' rosters differ and none is named.
    """
    players = league.store.players(league.league)
    if not players:
        raise ConfigError(
            (), f"league {league.league} has no players yet, whose rosters a policy must fit: run it once"
        )
    if team is not None:
        known = league.teams()
        if team not in known:
            raise UnknownName("team", team, known)
        return next(p.roster for p in players if p.team == known[team])
    rosters = dict.fromkeys(p.roster for p in players)
    if len(rosters) > 1:
        named = ", ".join(f"{next(p.name for p in players if p.roster == r)} ({r})" for r in rosters)
        raise ConfigError(("team",), f"the teams of league {league.league} are unlike, {named}: give --team")
    return next(iter(rosters))


def read(league: Open, kind: str, named: str, team: str | None) -> tuple[Program, str]:
    """Read and try the programs that a word names, separated by commas; return them and their roster.

    Raises ProgramError, one line, for what cannot play for the team.
    """
    roster = roster_of(league, team)
    return stored.read(kind, named.split(","), roster), roster


def bring_in(league: Open, program: Program, roster: str, name: str) -> Snapshot:
    """Add a program to a league as a snapshot that belongs to no player. Raises ConfigError if the name is taken."""
    store, data = league.store, program.to_bytes()
    digest = store.blobs.put(data)
    taken = {s.name: s for s in store.snapshots(league.league, brief=True)}
    if name in {p.name for p in store.players(league.league)} or (name in taken and taken[name].digest != digest):
        raise ConfigError(("as",), f"--as {name}: league {league.league} has a player or snapshot of that name already")
    store.add_snapshots([Snapshot(league.league, name, digest, roster, origin="imported")])
    return next(s for s in store.snapshots(league.league, brief=True) if s.name == name)


def describe(program: Program) -> str:
    """Describe how a program acts, and how long that takes."""
    how = "one world at a time" if program.singles else "all worlds at once"
    per = 1e3 * program.seconds
    agents = f"its {len(program.agents)} agents" if len(program.agents) > 1 else "one agent"
    return (
        f"It is {WORDS[program.kind]}, called on the CPU for {how}: a decision of {agents} in {stored.TIMED} worlds"
        f" takes {per:.2g} ms, which makes its matches slower."
    )
