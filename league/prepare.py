"""What only the heavy half of the program can check before a league runs, and the rows with which a league begins.

`prepare` starts a short-lived process, so that the one that stays, the manager, never loads jax, torch or mujoco. That
process builds the arena, examines the configuration against it and this machine, and only then writes: the league, its
players and the scripted opponents, all of which may be there already. What it refuses leaves nothing behind.
"""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from arenas.about import crowd
from arenas.blame import blame, sources
from league import devices, memory
from league.config import experiment as configuration
from league.config.experiment import Config
from league.config.schema import ConfigError, Key, literal, refuse
from league.config.sections import PlayerSettings, mains, named_players
from league.fading import floor
from league.heirs import Misfit, forerunners, heritage
from matchmaking.opponents import Opponents
from storage.errors import NotAStore
from storage.records import League, Player
from storage.store import Store

if TYPE_CHECKING:
    from arenas.arena import Arena

CPU_WORLDS, GPU_WORLDS = 256, 2048  # below 2,000 worlds a GPU waits for launches; more on a CPU make updates rarer


@dataclass(frozen=True)
class Prepared:
    """What a league's front needs to know of the heavy half."""

    arena: str
    engine: str
    worlds: int  # simulated at once in training
    sides: tuple[str, ...]  # each team in words, e.g. blue (2 × leatherback)


class PrepareError(Exception):
    """The process that prepares a league died, or hit a fault that is nobody's setting."""


# The light half ------------------------------------------------------------------------------------------------------


def prepare(where: str, config: Config, debug: bool = False) -> Prepared:
    """Examine a configuration and write what a league begins with, in a process of its own.

    Raises ConfigError, one line, for what cannot be; PrepareError where the process died. Ctrl-C ends both processes at
    once: nothing is lost, since nothing has been done.
    """
    request = {"where": where, "config": configuration.dumps(config), "parent": os.getpid()}
    process = subprocess.Popen(
        [sys.executable, "-m", "league.prepare"], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        stderr=None if debug else subprocess.PIPE, text=True,
    )  # fmt: skip
    with _ends_with_us(process):
        out, err = process.communicate(json.dumps(request))
    answer = json.loads(out or "{}")
    if "refused" in answer:
        raise ConfigError(tuple(answer["key"]), answer["refused"])
    if "prepared" not in answer:
        last = (err or "").strip().splitlines()[-1:] or ["it said nothing"]
        raise PrepareError(f"preparing the league failed (exit code {process.returncode}): {last[0]}")
    found = answer["prepared"]
    return Prepared(**{**found, "sides": tuple(found["sides"])})


@contextmanager
def _ends_with_us(process: subprocess.Popen[str]) -> Iterator[None]:
    """Until this is over, Ctrl-C and SIGTERM end the process and this one.

    An exception would not do: Python drops one that a signal raises while, say, a module is being imported.
    """

    def leave(number: int, frame: object) -> None:
        process.kill()
        os.write(2, b"\nleague: stopped before it began; nothing was lost.\n")
        os._exit(128 + number)

    before = {s: signal.getsignal(s) for s in (signal.SIGINT, signal.SIGTERM)}
    before = {s: handler for s, handler in before.items() if handler not in (signal.SIG_IGN, None)}
    for number in before:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# The heavy half ------------------------------------------------------------------------------------------------------


def examine(config: Config) -> "Arena":
    """Build the arena and try the configuration on it and on this machine; the arena is for looking at.

    Raises ConfigError, one line, naming the setting.
    """
    arena = _built(config)
    teams = [team.name for team in arena.teams]
    if config.training.schedule.learner >= len(teams):
        numbers = ", ".join(f"{i} ({name})" for i, name in enumerate(teams))
        key = ("training", "schedule", "learner")
        raise refuse(key, config.training.schedule.learner, f"the arena's teams are {numbers}")
    if config.budget.success is not None and len(teams) > 1:
        told = f"{arena.name} has {len(teams)} teams, and success is for one alone; use budget.reward or budget.steps"
        raise refuse(("budget", "success"), config.budget.success, told)
    _examine_critic(config, arena)
    least, until = floor(len(teams)), config.training.shaping_until
    if until is not None and until <= least:
        told = f"{arena.name} has {len(teams)} teams, each of which gets {least:.3g} for nothing; use more than that"
        raise refuse(("training", "shaping_until"), until, told)
    _examine_groups(config, teams)
    _examine_opponents(config, arena)
    _examine_players(config, teams)
    _examine_ladder(config, arena)
    _examine_scripts(config, arena)
    _examine_device(config, arena)
    _examine_memory(config, arena)
    return arena


def worlds(config: Config) -> int:
    """How many worlds training simulates at once, on all its devices; raises nothing."""
    import jax

    on_gpus = jax.default_backend() == "gpu"
    return config.training.worlds or (GPU_WORLDS * config.training.devices if on_gpus else CPU_WORLDS)


def roster(config: Config, teams: list[str]) -> tuple[PlayerSettings, ...]:
    """The players of a league, named: those of the configuration, else a main one for each of the teams."""
    return named_players(config.players) if config.players else mains(tuple(teams))


def players_of(config: Config, arena: "Arena") -> list[Player]:
    """The players of a league as rows of its store."""
    teams = [team.name for team in arena.teams]
    return [
        Player(config.league, p.name, teams.index(p.team), p.role, arena.teams[teams.index(p.team)].roster, p.group)
        for p in roster(config, teams)
    ]


def create(store: Store, config: Config, arena: "Arena") -> None:
    """Write the league, its players and the scripted opponents; what exists already stays.

    Raises StorageError, before anything is written, where the league has players that contradict these.
    """
    from league.exchange import bring_in_trained
    from league.fits import examine_checkpoints
    from league.policies import add_scripts
    from league.query import Open

    players = players_of(config, arena)
    if config.league in {league.name for league in store.leagues()}:
        _examine_rosters(store, config, arena, players)
        examine_checkpoints(store, config, arena, players)
        gone = sorted({p.name for p in store.players(config.league)} - {p.name for p in players})
        if gone:
            raise ConfigError(
                ("players",),
                f"league {config.league} has players that the settings do not name ({', '.join(gone)}): name them in"
                " [[players]], or choose another league name",
            )
        store.add_players(players)  # refuses those that contradict what is there
    store.create_league(League(config.league, configuration.dumps(config)))
    store.add_players(players)
    add_scripts(store, config.league, arena, _scripts(config, arena))
    if config.rating.trained:
        bring_in_trained(Open(store, config.league), arena.name)


def _examine_rosters(store: Store, config: Config, arena: "Arena", players: list[Player]) -> None:
    """A league's policies must fit: another arena can only go on with it if its teams are the same to them."""
    known = {p.name: p for p in store.players(config.league)}
    for player in players:
        kept = known.get(player.name)
        if kept is not None and kept.roster != player.roster:
            raise ConfigError(
                ("league",),
                f"league {config.league!r} cannot go on in {arena.name}: its player {kept.name} fits {kept.roster}, not"
                f" {player.roster}; choose another league name",
            )


def _examine_heritage(where: str, config: Config, stages: list[list[Player]]) -> None:
    """Each stage's players must fit those from which they start; those of earlier stages are not there yet."""
    before = _forerunners(where, config)
    for number, players in enumerate(stages):
        try:
            heritage(players, before)
        except Misfit as error:
            key = ("stages", str(number), "arena") if config.stages else ("after",)
            told = f"stage {config.stages[number].name}" if config.stages else f"after {', '.join(config.after)}"
            raise ConfigError(key, f"{told}: {error}") from None
        before.insert(0, players)


def _forerunners(where: str, config: Config) -> list[Sequence[Player]]:
    """The players of what is named in `after`; a store that is not there yet has none."""
    if not config.after:
        return []
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            return forerunners(store, config.after)
    except NotAStore:
        return forerunners(None, config.after)


def _examine_start(where: str, config: Config, arena: "Arena") -> None:
    """A new league's players must be able to take over the networks of what is named in `after`."""
    from league.fits import examine_start

    players = players_of(config, arena)
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            if config.league not in {league.name for league in store.leagues()}:
                examine_start(store, config, arena, players)
    except NotAStore:
        examine_start(None, config, arena, players)


def _built(config: Config) -> "Arena":
    from arenas.errors import ArenaError, EngineError

    name = config.arena.name
    try:
        arena = config.arena.build(engine=config.engine, threads=1)
        if ":" in name:  # a person's own: find out now what else every worker would find out
            _trace(arena)
    except EngineError as error:
        raise ConfigError(("engine",), str(error)) from None
    except ArenaError as error:
        raise ConfigError(("arena",), str(error)) from None
    except (Exception, SystemExit) as error:
        told = f"arena {name}: {blame(error, sources(name))}; `league check {name}` examines it"
        raise ConfigError(("arena",), told) from error
    return arena


def _trace(arena: "Arena") -> None:
    """Run reset and step on shapes alone: cheap, and it meets most mistakes of an arena's code."""
    import jax

    state = jax.eval_shape(arena.reset, jax.random.key(0))
    actions = {agent.name: jax.ShapeDtypeStruct((agent.action_size,), "float32") for agent in arena.agents}
    jax.eval_shape(arena.step, state, actions)


def _examine_critic(config: Config, arena: "Arena") -> None:
    """What the critic is to see must be there to be seen."""
    sees, told = config.learner.critic_input, ""
    if sees in ("all", "same") and len(arena.teams) == 1:
        told = f"{arena.name} has one team, and there are no others to see; use own"
    if sees == "privileged" and not arena.privileged_size:
        told = f"{arena.name} has no bodies, and offers no state beside what is observed; use own or all"
    if told:
        raise refuse(("learner", "critic_input"), sees, told)


def _examine_groups(config: Config, teams: list[str]) -> None:
    """Every group of a turn needs a world: one group, or some, of present opponents, and each learner's past ones."""
    together: dict[str, list[Opponents]] = {}
    for player in roster(config, teams):
        if config.role(player.role).learns:
            together.setdefault(player.group, []).append(config.opponents(player))
    for rules in together.values():
        most = rules if config.training.schedule.kind == "simultaneous" else rules[:1]
        past, present = sum(rule.split().past for rule in most), max(rule.split().present for rule in most)
        groups, count = present + past, worlds(config)
        if past and len(teams) > 1 and groups > count:
            told = (
                f"{len(most)} who learn meet past opponents in {past} groups, beside {present} of present ones: with"
                f" {count} worlds there can be no {groups} groups; use more training.worlds, or fewer groups"
            )
            raise refuse(("training", "opponents", "groups"), config.training.opponents.groups, told)


def _rules(config: Config, teams: list[str]) -> list[tuple[Key, Opponents]]:
    """The rules by which players of the league meet others, with the key under which each stands."""
    used = {p.role for p in roster(config, teams)}
    own = [(("roles", str(i), "opponents"), role.opponents) for i, role in enumerate(config.roles) if role.name in used]
    return [(("training", "opponents"), config.training.opponents), *((key, rule) for key, rule in own if rule)]


def _examine_opponents(config: Config, arena: "Arena") -> None:
    """Alpha-rank is of one population: snapshots of the other team must be able to play each other."""
    rosters = list(dict.fromkeys(team.roster for team in arena.teams))
    for key, rule in _rules(config, [team.name for team in arena.teams]):
        if rule.kind == "alpharank" and len(rosters) > 1:
            told = f"the teams of {arena.name} are unlike ({', '.join(rosters)}), and no population; use nash"
            raise refuse((*key, "kind"), "alpharank", told)


def _examine_victim(where: str, config: Config, arena: "Arena") -> None:
    """Whom players always meet must be there, or come with the league."""
    from league.policies import script_titles

    victims = {(*key, "victim"): rule.victim for key, rule in _rules(config, [team.name for team in arena.teams])}
    if not any(victims.values()):
        return
    known = list(script_titles(arena, _scripts(config, arena))) + [f"{p.name}@0" for p in players_of(config, arena)]
    try:
        with Store.open(where, blobs=config.storage.blobs) as store:
            if config.league in {league.name for league in store.leagues()}:
                known = list(dict.fromkeys([*known, *(s.name for s in store.snapshots(config.league))]))
    except NotAStore:
        pass
    for key, victim in victims.items():
        if victim and victim not in known:
            shown = ", ".join(known[:12]) + (", ..." if len(known) > 12 else "")
            raise refuse(key, victim, f"the league has no snapshot of that name; there are: {shown}")


def _examine_players(config: Config, teams: list[str]) -> None:
    for i, player in enumerate(config.players):
        if player.team not in teams:
            raise refuse(("players", str(i), "team"), player.team, f"the arena's teams are {', '.join(teams)}")
    idle = [team for team in teams if team not in {p.team for p in roster(config, teams)}]
    if idle:
        raise ConfigError(("players",), f"players: nobody plays team {idle[0]}; add a [[players]] table for it")


def _examine_ladder(config: Config, arena: "Arena") -> None:
    """What one team learns can be copied to another with the same robots in the same order, and the same networks."""
    if config.training.schedule.kind != "ladder":
        return
    learner, widths = arena.teams[config.training.schedule.learner], config.learner.architecture.hidden
    for team in arena.teams:
        if team.roster != learner.roster:
            told = (
                f"what {learner.name} ({learner.roster}) learns cannot be copied to {team.name} ({team.roster}): ladder"
                " needs equal rosters; use simultaneous, leapfrog or frozen"
            )
            raise refuse(("training", "schedule", "kind"), "ladder", told)
    players = roster(config, [team.name for team in arena.teams])
    copied = {p.group: p.hidden or widths for p in players if p.team == learner.name}
    for i, player in enumerate(players):
        own = player.hidden or widths
        if own != (wanted := copied.get(player.group, own)):
            told = (
                f"ladder copies its group's {learner.name} here, whose widths are {literal(wanted)}; give both the same"
            )
            raise refuse(("players", str(i), "hidden"), own, told)


def _scripts(config: Config, arena: "Arena") -> tuple[str, ...]:
    """The scripted opponents of the league's pool: by default all that a whole team of the arena can play."""
    if config.rating.scripts is not None:
        return config.rating.scripts
    return tuple(dict.fromkeys(name for team in arena.teams for name in arena.playable(team)))


def _examine_scripts(config: Config, arena: "Arena") -> None:
    known = {name for team in arena.teams for name in arena.playable(team)}
    for name in config.rating.scripts or ():
        if name not in known:
            listed = ", ".join(sorted(known)) or "none"
            raise ConfigError(("rating", "scripts"), f"rating.scripts: {arena.name} has no script {name!r} ({listed})")
    for player in roster(config, [team.name for team in arena.teams]):
        if player.name in known:
            raise ConfigError(("players",), f"players: {player.name} is the name of a scripted opponent; use another")


def _examine_device(config: Config, arena: "Arena") -> None:
    if config.training.device == "cuda" and not devices.torch_has_cuda():
        raise refuse(("training", "device"), "cuda", "torch sees no CUDA device here; use auto or cpu")
    if 0 < (gpus := len(devices.gpus())) < config.training.devices:
        told = (
            f"the GPUs that may be used here are {gpus}, and no two processes of a turn share one; use {gpus} or less"
        )
        raise refuse(("training", "devices"), config.training.devices, told)
    if config.deterministic and arena.engine.name == "warp":
        raise ConfigError(("engine",), "deterministic: engine warp does not repeat itself to the bit; use engine c")


def _examine_memory(config: Config, arena: "Arena") -> None:
    """Refuse a batch of experience that cannot fit, rather than be killed by the operating system over it."""
    import jax

    at_once = 1 if jax.default_backend() == "gpu" else len(arena.teams)
    total, needed = memory.machine(), memory.learning(config, arena, worlds(config), at_once)
    if needed > memory.SHARE * total:
        raise ConfigError(
            ("training", "worlds"),
            f"training.worlds × training.rollout = {worlds(config)} × {config.training.rollout}: such a batch needs"
            f" about {needed / 1e9:.0f} GB, and this machine has {total / 1e9:.0f} GB",
        )


def _serve(request: Mapping[str, Any]) -> Prepared:
    """Do what `prepare` asks for."""
    config = configuration.loads(request["config"])
    stages = [configuration.stage(config, number) for number in range(len(config.stages))]
    arenas = [examine(each) for each in stages or [config]]
    if os.getppid() != request["parent"]:
        raise PrepareError("the process that asked has gone; nothing was written")
    _examine_heritage(request["where"], config, list(map(players_of, stages or [config], arenas)))
    first = (stages or [config])[0]
    if first.after:
        _examine_start(request["where"], first, arenas[0])
    _examine_victim(request["where"], first, arenas[0])
    with Store.open(request["where"], create=True, blobs=config.storage.blobs) as store:
        if stages:  # each is made when it is its turn
            store.create_league(League(config.league, configuration.dumps(config)))
        else:
            create(store, config, arenas[0])
    arena = arenas[0]
    sides = tuple(f"{t.name} ({crowd(a.kind for a in t.agents)})" for t in arena.teams)
    return Prepared(arena.name, arena.engine.name, worlds(config), sides)


def main() -> None:
    """Read a request from stdin and answer it on stdout: the process that `prepare` starts."""
    from league import environment
    from storage.errors import StorageError

    environment.prepare()
    with os.fdopen(os.dup(1), "w") as answer:
        os.dup2(2, 1)  # libraries greet on stdout
        try:
            told: dict[str, Any] = {"prepared": asdict(_serve(json.load(sys.stdin)))}
        except ConfigError as error:
            told = {"refused": error.message, "key": error.key}
        except StorageError as error:
            told = {"refused": str(error), "key": ()}
        json.dump(told, answer)


if __name__ == "__main__":
    main()
