"""What of a configuration must fit its arena and this machine: found out before a league is made.

Loads what is heavy only where it is used, for the settings that are told here are also asked for by light commands.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from arenas.blame import blame, sources
from league import devices, memory
from league.config.experiment import Config
from league.config.schema import ConfigError, Key, literal, refuse
from league.config.sections import PlayerSettings, mains, named_players
from league.fading import floor
from matchmaking.opponents import Opponents

if TYPE_CHECKING:
    from arenas.arena import Arena

CPU_WORLDS, GPU_WORLDS = 256, 2048  # below 2,000 worlds a GPU waits for launches; more on a CPU make updates rarer


def examine(config: Config) -> "Arena":
    """Build the arena as for training and try the configuration on it and on this machine.

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
    _examine_pbt(config, teams)
    _examine_scripts(config, arena)
    _examine_device(config, arena)
    _examine_memory(config, arena)
    return arena


def worlds(config: Config) -> int:
    """How many worlds training simulates at once, on all its devices; raises nothing."""
    import jax

    on_gpus = jax.default_backend() == "gpu"
    return config.training.worlds or (GPU_WORLDS * config.training.devices if on_gpus else CPU_WORLDS)


def build(config: Config, count: int) -> "Arena":
    """The league's arena for so many worlds, as each worker has it; a GPU's buffers depend on their number."""
    return config.arena.build(engine=config.engine, worlds=count, threads=config.workers.threads)


@dataclass(frozen=True)
class Built:
    """An arena that this process has, and what it was built from."""

    arena: "Arena"
    config: Config
    worlds: int

    def again(self, config: Config, count: int) -> "Arena":
        """What `build` gives: this one where a new one would be the same."""
        asked, had = (
            (each.arena, each.engine, each.workers.threads, worlds)
            for each, worlds in ((config, count), (self.config, self.worlds))
        )
        return self.arena if asked == had else build(config, count)


def roster(config: Config, teams: list[str]) -> tuple[PlayerSettings, ...]:
    """The players of a league, named: those of the configuration, else a main one for each of the teams."""
    return named_players(config.players) if config.players else mains(tuple(teams))


def _built(config: Config) -> "Arena":
    from arenas.errors import ArenaError, EngineError

    name = config.arena.name
    try:
        arena = build(config, worlds(config))
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


def rules(config: Config, teams: list[str]) -> list[tuple[Key, Opponents]]:
    """The rules by which players of the league meet others, with the key under which each stands."""
    used = {p.role for p in roster(config, teams)}
    own = [(("roles", str(i), "opponents"), role.opponents) for i, role in enumerate(config.roles) if role.name in used]
    return [(("training", "opponents"), config.training.opponents), *((key, rule) for key, rule in own if rule)]


def _examine_opponents(config: Config, arena: "Arena") -> None:
    """Alpha-rank is of one population: snapshots of the other team must be able to play each other."""
    rosters = list(dict.fromkeys(team.roster for team in arena.teams))
    for key, rule in rules(config, [team.name for team in arena.teams]):
        if rule.kind == "alpharank" and len(rosters) > 1:
            told = f"the teams of {arena.name} are unlike ({', '.join(rosters)}), and no population; use nash"
            raise refuse((*key, "kind"), "alpharank", told)


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


def _examine_pbt(config: Config, teams: list[str]) -> None:
    """Population based training needs players of one team, one role and one network."""
    if config.training.pbt.ready is None:
        return
    groups: dict[tuple[str, str], list[PlayerSettings]] = {}
    for player in roster(config, teams):
        groups.setdefault((player.team, player.role), []).append(player)
    if all(len(each) < 2 for each in groups.values()):
        told = "no team has two players of one role, so nobody can copy anybody; add [[players]], or leave it out"
        raise refuse(("training", "pbt", "ready"), config.training.pbt.ready, told)
    for (team, role), each in groups.items():
        widths = dict.fromkeys(player.hidden or config.learner.architecture.hidden for player in each)
        if len(widths) > 1:
            told = f"the {role} players of {team} have networks of {' and '.join(map(literal, widths))}: who copies"
            told += " another needs its network, so give them the same"
            raise refuse(("training", "pbt", "ready"), config.training.pbt.ready, told)


def scripts(config: Config, arena: "Arena") -> tuple[str, ...]:
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
    if config.learner.compiled and (lacking := devices.lacks_to_compile()):
        raise refuse(("learner", "compiled"), True, f"torch.compile needs {lacking}, and none is here; use false")
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
