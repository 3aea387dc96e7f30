"""The checks of a configuration against its arena and this machine, made before a league is created.

Heavy imports are local, because fast commands also import this module.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from agents.settings import HAPPO
from arenas.errors import ArenaError, EngineError, describe_error, source_files
from league.config.build import build as build_config
from league.config.experiment import Config
from league.config.flags import check_classes
from league.config.schema import ConfigError, Key, dotted, literal, refuse
from league.config.sections import ENOUGH, PlayerSettings, mains, named_players
from league.state.team_exchange import as_made
from league.system import devices, memory
from league.system.arena_build import build, rating_batch, worlds
from league.training.reward_shaping import chance_score
from matchmaking.opponents import Opponents
from storage.errors import StorageError
from storage.records import Player

if TYPE_CHECKING:
    from arenas.arena import Arena


def validate(config: Config, players: Sequence[Player] = ()) -> "Arena":
    """Build the arena as for training, and check the configuration against it and this machine.

    `players` are those that the league has already. Raises ConfigError, one line that names the setting.
    """
    check_classes(config)
    arena = as_made(_built(config), players)
    teams = [team.name for team in arena.teams]
    if config.training.schedule.learner >= len(teams):
        numbers = ", ".join(f"{i} ({name})" for i, name in enumerate(teams))
        key = ("training", "schedule", "learner")
        raise refuse(key, config.training.schedule.learner, f"the arena's teams are {numbers}")
    if config.budget.success is not None and len(teams) > 1:
        message = f"{arena.name} has {len(teams)} teams, and success is for one alone"
        message += "; use budget.score, budget.reward or budget.steps"
        raise refuse(("budget", "success"), config.budget.success, message)
    if config.budget.score is not None and len(teams) == 1:
        message = f"{arena.name} has one team, which has nobody to score against; use budget.success"
        raise refuse(("budget", "score"), config.budget.score, message)
    _validate_critic(config, arena)
    least, until = chance_score(len(teams)), config.training.shaping_until
    if until is not None and until <= least:
        message = f"{arena.name} has {len(teams)} teams, each of which gets {least:.3g} for nothing; use more than that"
        raise refuse(("training", "shaping_until"), until, message)
    _validate_groups(config, teams)
    _validate_rating(config, teams)
    _validate_opponents(config, arena)
    _validate_players(config, teams)
    _validate_ladder(config, arena)
    _validate_entities(config, arena)
    _validate_after_parts(config)
    _validate_pbt(config, teams)
    _validate_skills(config, arena)
    _validate_learners(config, arena)
    _validate_scripts(config, arena)
    if config.deterministic and arena.engine.name == "warp":
        raise ConfigError(("engine",), "deterministic: engine warp does not repeat itself to the bit; use engine c")
    if config.workers.train:  # otherwise other machines learn
        _validate_device(config)
        _validate_batch(config)
        _validate_memory(config, arena)
    return arena


def early_restarts(config: Config, arena: "Arena", worlds: int) -> list[str]:
    """Return a line if worlds begin anew before half of them can play the arena's longest game to its end.

    All worlds of a deterministic league begin anew every turn, in ladder every phase, and in leapfrog those against the
    learner's history every phase. The first episode of each is cut at random, up to the longest, so all of them can
    after two longest.
    """
    training, schedule, decisions = config.training, config.training.schedule, arena.timing.decisions
    rollout, enough = training.rollout_length, -(-2 * decisions // training.rollout_length)
    past = any(rule.share for _, rule in rules(config, [team.name for team in arena.teams]))
    if config.deterministic:
        what = "in a deterministic league worlds begin anew every turn"
        span, mend = training.iterations_per_turn * rollout, f"iterations_per_turn = {enough}"
    elif schedule.kind == "ladder" or (schedule.kind == "leapfrog" and past):
        which = "" if schedule.kind == "ladder" else " against past opponents"
        what = f"in {schedule.kind} worlds{which} begin anew every phase"
        if schedule.period_steps is None:
            span, mend = schedule.period * rollout, f"schedule.period = {enough}"
        else:
            span, mend = -(-schedule.period_steps // worlds), f"schedule.period_steps = {enough * rollout * worlds}"
    else:
        return []
    if span >= ENOUGH * decisions:
        return []
    return [
        f"{what}, after {span:,} decisions, and a game may have {decisions:,}: players hardly learn how games end by"
        f" time; give training.{mend} or more"
    ]


def _validate_batch(config: Config) -> None:
    """Raise ConfigError if a batch cannot be divided as asked, where training has this machine's number of worlds."""
    build_config(Config, {"training": {"worlds": worlds(config)}}, config)


def roster(config: Config, teams: list[str]) -> tuple[PlayerSettings, ...]:
    """Return the named players of a league: those of the configuration, or a main player for each team."""
    return named_players(config.players) if config.players else mains(tuple(teams))


def _built(config: Config) -> "Arena":
    name = config.arena.name
    try:
        arena = build(config, worlds(config))
        if ":" in name:  # a user's own arena: find its mistakes now rather than in each worker
            _examine_shapes(arena)
    except ConfigError:
        raise
    except EngineError as error:
        raise ConfigError(("engine",), str(error)) from None
    except ArenaError as error:
        raise ConfigError(("arena",), str(error)) from None
    except (Exception, SystemExit) as error:
        message = f"arena {name}: {describe_error(error, source_files(name))}; `league check {name}` examines it"
        raise ConfigError(("arena",), message) from error
    return arena


def _examine_shapes(arena: "Arena") -> None:
    """Run the hooks, reset and step on shapes alone, which is cheap and finds most mistakes in an arena's code.

    Raises ConfigError for hooks that return other names, shapes or types than the arena declares, and the error of the
    arena's own code, if any.
    """
    import jax

    from arenas.contract.check_run import CheckRun
    from arenas.contract.shape_checks import check_shapes

    if problem := check_shapes(CheckRun(arena, jax.random.key(0))):
        name = arena.name
        raise ConfigError(("arena",), f"arena {name}: {problem}; `league check {name}` examines it")
    state = jax.eval_shape(arena.reset, jax.random.key(0))
    actions = {agent.name: jax.ShapeDtypeStruct((agent.action_size,), "float32") for agent in arena.agents}
    jax.eval_shape(arena.step, state, actions)


def _validate_critic(config: Config, arena: "Arena") -> None:
    """Raise ConfigError if the arena lacks observations that the critic needs."""
    sees, message = config.learner.critic_input, ""
    if sees in ("all", "same") and len(arena.teams) == 1:
        message = f"{arena.name} has one team, and there are no others to see; use own"
    if sees == "privileged" and not arena.privileged_size:
        message = f"{arena.name} has no bodies, and offers no state beside what is observed; use own or all"
    if message:
        raise refuse(("learner", "critic_input"), sees, message)


def _validate_groups(config: Config, teams: list[str]) -> None:
    """Raise ConfigError if a turn has more groups than worlds.

    A turn has one or more groups with present opponents, and those with each learner's past opponents.
    """
    together: dict[str, list[Opponents]] = {}
    for player in roster(config, teams):
        if config.role(player.role).learns:
            together.setdefault(player.group, []).append(config.opponents(player))
    for rules in together.values():
        most = rules if config.training.schedule.kind == "simultaneous" else rules[:1]
        past, present = sum(rule.split().past for rule in most), max(rule.split().present for rule in most)
        groups, count = present + past, worlds(config)
        if past and len(teams) > 1 and groups > count:
            message = (
                f"{len(most)} who learn meet past opponents in {past} groups, beside {present} of present ones: with"
                f" {count} worlds there can be no {groups} groups; use more training.worlds, or fewer groups"
            )
            raise refuse(("training", "opponents", "groups"), config.training.opponents.groups, message)


def _validate_rating(config: Config, teams: list[str]) -> None:
    """Raise ConfigError if a batch of rating matches has fewer worlds than teams of its lineups."""
    batch = rating_batch(config)
    if batch.worlds < batch.pairings * len(teams):
        message = f"each of {batch.pairings} lineups needs a world for each of {len(teams)} seatings"
        raise refuse(("rating", "worlds"), batch.worlds, f"{message}; use {batch.pairings * len(teams)} or more")


def rules(config: Config, teams: list[str]) -> list[tuple[Key, Opponents]]:
    """Return the rules of opponent sampling that the league's players use, each with its key in the settings."""
    used = {p.role for p in roster(config, teams)}
    own = [(("roles", str(i), "opponents"), role.opponents) for i, role in enumerate(config.roles) if role.name in used]
    return [(("training", "opponents"), config.training.opponents), *((key, rule) for key, rule in own if rule)]


def _validate_opponents(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for alpha-rank if snapshots of the other team cannot play each other, which it requires."""
    rosters = list(dict.fromkeys(team.roster for team in arena.teams))
    for key, rule in rules(config, [team.name for team in arena.teams]):
        if rule.kind == "alpharank" and len(rosters) > 1:
            message = f"the teams of {arena.name} are unlike ({', '.join(rosters)}), and no population; use nash"
            raise refuse((*key, "kind"), "alpharank", message)


def _validate_players(config: Config, teams: list[str]) -> None:
    """Raise ConfigError for a player of an unknown team, and for a team without players."""
    for i, player in enumerate(config.players):
        if player.team not in teams:
            raise refuse(("players", str(i), "team"), player.team, f"the arena's teams are {', '.join(teams)}")
    idle = [team for team in teams if team not in {p.team for p in roster(config, teams)}]
    if idle:
        raise ConfigError(("players",), f"players: nobody plays team {idle[0]}; add a [[players]] table for it")


def _validate_ladder(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for a ladder between teams that differ in robots, in their order, or in networks."""
    if config.training.schedule.kind != "ladder":
        return
    learner, widths = arena.teams[config.training.schedule.learner], config.learner.architecture.hidden
    for team in arena.teams:
        if team.roster != learner.roster:
            message = (
                f"what {learner.name} ({learner.roster}) learns cannot be copied to {team.name} ({team.roster}): ladder"
                " needs equal rosters; use simultaneous, leapfrog or frozen"
            )
            raise refuse(("training", "schedule", "kind"), "ladder", message)
    players = roster(config, [team.name for team in arena.teams])
    copied = {p.group: p.hidden or widths for p in players if p.team == learner.name}
    for i, player in enumerate(players):
        own = player.hidden or widths
        if own != (wanted := copied.get(player.group, own)):
            message = (
                f"ladder copies its group's {learner.name} here, whose widths are {literal(wanted)}; give both the same"
            )
            raise refuse(("players", str(i), "hidden"), own, message)


def _validate_entities(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for networks that encode entities, where no observation has any."""
    width = config.learner.architecture.entities
    if width and not any(agent.entities for agent in arena.agents):
        message = f"arena {arena.name} names no sets of entities in its observations; use 0"
        raise refuse(("learner", "architecture", "entities"), width, message)


def _validate_skills(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for skills that cannot act in the arena."""
    if not config.learner.skill.policies:
        return
    from league.snapshots.transfer.skills import SkillError, check_skills

    try:
        check_skills(config.learner.skill, arena)
    except SkillError as error:
        name, _, message = str(error).partition(": ")
        raise ConfigError(("learner", "skill", name), f"learner.skill.{name}: {message}") from None
    except StorageError as error:
        raise ConfigError(("learner", "skill", "policies"), f"learner.skill.policies: {error}") from None


def _validate_pbt(config: Config, teams: list[str]) -> None:
    """Raise ConfigError for population based training without two players of one team, role and network."""
    if config.training.pbt.ready is None:
        return
    groups: dict[tuple[str, str], list[PlayerSettings]] = {}
    for player in roster(config, teams):
        groups.setdefault((player.team, player.role), []).append(player)
    if all(len(each) < 2 for each in groups.values()):
        message = "no team has two players of one role, so nobody can copy anybody; add [[players]], or leave it out"
        raise refuse(("training", "pbt", "ready"), config.training.pbt.ready, message)
    for (team, role), each in groups.items():
        widths = dict.fromkeys(player.hidden or config.learner.architecture.hidden for player in each)
        if len(widths) > 1:
            message = f"the {role} players of {team} have networks of {' and '.join(map(literal, widths))}: who copies"
            message += " another needs its network, so give them the same"
            raise refuse(("training", "pbt", "ready"), config.training.pbt.ready, message)


def _validate_after_parts(config: Config) -> None:
    """Raise ConfigError if networks are to go on by parts of observations and cannot: see `checkpoint.with_inputs`."""
    for name in ("layer_norm", "entities"):
        if config.after_parts and (value := getattr(config.learner.architecture, name)):
            message = (
                "after_parts is for networks whose first layer sees the observation as it is; leave one of both out"
            )
            raise refuse(("learner", "architecture", name), value, message)


def _validate_learners(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for a player's learner of another class that cannot be made, or cannot do what is asked."""
    players = roster(config, [team.name for team in arena.teams])
    classes = {p.name: p.class_ or config.learner.class_ for p in players}
    own = [(i, p) for i, p in enumerate(players) if classes[p.name] != HAPPO]
    if not own:
        return
    what = f"learner.class = {literal(classes[own[0][1].name])}"
    if config.training.devices > 1:
        raise refuse(("training", "devices"), config.training.devices, f"{what} learns on one device; use 1")
    if config.training.pbt.ready is not None:
        message = f"{what} has no hyperparameters that the league could move; leave it out"
        raise refuse(("training", "pbt", "ready"), config.training.pbt.ready, message)
    for i, player in own:
        if config.own_after.get(player.name, config.after):
            key = ("after",) if player.after is None else ("players", str(i), "after")
            raise ConfigError(key, f"{dotted(key)}: {what} starts afresh, and takes over no networks of other leagues")
    if config.training.schedule.kind == "ladder" and len(set(classes.values())) > 1:
        message = "ladder copies what one player learns to the others, whose learners are of another class"
        raise refuse(("training", "schedule", "kind"), "ladder", message)
    for i, player in own:
        _validate_learner(config, arena, i, player)


def _validate_learner(config: Config, arena: "Arena", number: int, player: PlayerSettings) -> None:
    """Make a player's learner of another class, and try its verbs; raises ConfigError."""
    from league.training.learner_factory import new_learner
    from league.training.own_learner import OwnLearner
    from league.training.setback import PlayerDiverged

    key = ("players", str(number), "class") if player.class_ is not None else ("learner", "class")
    if config.role(player.role).reset == "main":
        message = f"{player.name}'s role resets it to another player's policy, which only {HAPPO} takes over"
        raise refuse(key, player.class_ or config.learner.class_, message)
    for name in ("hidden", "lr"):
        if getattr(player, name) is not None:
            message = f"is a setting of {HAPPO}; give {player.name}'s learner its own in settings"
            raise refuse(("players", str(number), name), getattr(player, name), message)
    teams = [team.name for team in arena.teams]
    row = Player(config.league, player.name, teams.index(player.team), player.role, "", player.group)
    try:
        made = new_learner(config, arena, row)
        assert isinstance(made, OwnLearner)
        made.try_out()
    except PlayerDiverged as error:
        raise ConfigError(key, f"{dotted(key)}: {error}") from None


def scripts(config: Config, arena: "Arena") -> tuple[str, ...]:
    """Return the scripted opponents of the league's pool: by default all that a whole team of the arena can play."""
    if config.rating.scripts is not None:
        return tuple(dict.fromkeys([*config.rating.scripts, *config.budget.against]))
    return tuple(dict.fromkeys(name for team in arena.teams for name in arena.playable_scripts(team)))


def _validate_scripts(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for a script that the arena lacks, and for a player with the name of a script."""
    known = {name for team in arena.teams for name in arena.playable_scripts(team)}
    named = {("rating", "scripts"): config.rating.scripts or (), ("budget", "against"): config.budget.against}
    for key, names in named.items():
        if unknown := next((name for name in names if name not in known), None):
            listed = ", ".join(sorted(known)) or "none"
            raise ConfigError(key, f"{'.'.join(key)}: {arena.name} has no script {unknown!r} ({listed})")
    for team in arena.teams if config.budget.against else ():
        rivals = [each for each in arena.teams if each.name != team.name]
        if not any(name in arena.playable_scripts(each) for each in rivals for name in config.budget.against):
            message = f"no other team than {team.name} can play one of these scripts; name one that its opponents can"
            raise refuse(("budget", "against"), list(config.budget.against), message)
    for player in roster(config, [team.name for team in arena.teams]):
        if player.name in known:
            raise ConfigError(("players",), f"players: {player.name} is the name of a scripted opponent; use another")


def _validate_device(config: Config) -> None:
    """Raise ConfigError if this machine lacks the devices or the compiler."""
    if config.training.device == "cuda" and not devices.torch_has_cuda():
        raise refuse(("training", "device"), "cuda", "torch sees no CUDA device here; use auto or cpu")
    if 0 < (gpus := len(devices.gpus())) < config.training.devices:
        message = (
            f"the GPUs that may be used here are {gpus}, and no two processes of a turn share one; use {gpus} or less"
        )
        raise refuse(("training", "devices"), config.training.devices, message)
    if config.learner.compiled and (lacking := devices.lacks_to_compile()):
        raise refuse(("learner", "compiled"), True, f"torch.compile needs {lacking}, and none is here; use false")


def _validate_memory(config: Config, arena: "Arena") -> None:
    """Raise ConfigError for a batch of experience that cannot fit, before the operating system kills a process."""
    import jax

    at_once = 1 if jax.default_backend() == "gpu" else len(arena.teams)
    total, needed = memory.machine(), memory.learning(config, arena, worlds(config), at_once)
    if needed > memory.SHARE * total:
        raise ConfigError(
            ("training", "worlds"),
            f"training.worlds × training.rollout_length = {worlds(config)} × {config.training.rollout_length}: such a"
            f" batch needs about {needed / 1e9:.0f} GB, and this machine has {total / 1e9:.0f} GB",
        )
