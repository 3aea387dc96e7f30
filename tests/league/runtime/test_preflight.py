"""What only the heavy half can refuse, and that it writes nothing then; that the light half stays light."""

import os
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from league.config import experiment as configuration
from league.config import presets
from league.config.run_spec import RunSpec
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.runtime import preflight
from league.runtime.bootstrap import create
from league.runtime.preflight import prepare
from league.runtime.validation import early_restarts, roster, scripts, validate
from league.scheduling.episode_lengths import settles
from league.system import devices
from league.system.arena_build import worlds
from matchmaking.opponents import Opponents
from matchmaking.schedule import Schedule
from storage.store import Store
from tests.league.conftest import ROOT


def duel(**changes: object) -> configuration.Config:
    return replace(presets.preset("duel"), **changes)


@pytest.mark.parametrize(
    ("toml", "key", "says"),
    [
        ("schedule.learner = 2", "training.schedule.learner", "the arena's teams are 0 (blue), 1 (red)"),
        ('device = "cuda"', "training.device", "torch sees no CUDA device"),
        ("worlds = 1048576\nrollout_length = 10000", "training.worlds", "GB"),
        ('opponents.kind = "alpharank"\n[arena]\nname = "matching-pennies"', "training.opponents.kind", "use nash"),
        ('[rating]\nscripts = ["idle", "clown"]', "rating.scripts", "no script 'clown' (centre-holder, idle,"),
        ('[budget]\nscore = 0.8\nagainst = ["clown"]', "budget.against", "no script 'clown' (centre-holder, idle,"),
        ('[arena]\nname = "pursuit"\n[budget]\nscore = 0.8\nagainst = ["runner"]', "budget.against", "than prey can"),
        ("[learner]\nminibatches = 1000000", "learner.minibatches", "a batch has only"),  # of the machine's own size
        ('[[players]]\nteam = "green"', "players.0.team", "the arena's teams are blue, red"),
        ('[[players]]\nteam = "blue"', "players", "nobody plays team red"),
        ('[[players]]\nteam = "blue"\nname = "idle"\n[[players]]\nteam = "red"', "players", "name of a script"),
    ],
)  # fmt: skip
def test_what_arena_or_machine_cannot_do_is_refused_with_its_key(toml, key, says):
    if "cuda" in toml:
        import torch

        if torch.cuda.is_available():
            pytest.skip("this machine has a CUDA device")
    arena = "" if "[arena]" in toml else 'arena.name = "sumo-1v1"\n'
    config = configuration.loads(f"{arena}[training]\n{toml}\n")
    with pytest.raises(ConfigError) as caught:
        validate(config)
    assert ".".join(caught.value.key) == key
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def lasting(decisions: int) -> SimpleNamespace:
    """As much of an arena as tells how long its games may be."""
    return SimpleNamespace(timing=SimpleNamespace(decisions=decisions), teams=[SimpleNamespace(name="blue")])


def test_worlds_that_begin_anew_before_games_can_end_are_told():
    training = replace(duel().training, rollout_length=48, iterations_per_turn=16)
    config = duel(deterministic=True, training=training, budget=configuration.Budget(steps=10**6))
    (line,) = early_restarts(config, lasting(1500), 64)
    assert "every turn, after 768 decisions, and a game may have 1,500" in line
    assert "training.iterations_per_turn = 63 or more" in line
    assert not early_restarts(replace(config, training=replace(training, iterations_per_turn=63)), lasting(1500), 64)
    assert not early_restarts(config, lasting(512), 64)
    assert not early_restarts(replace(config, deterministic=False), lasting(1500), 64)


@pytest.mark.parametrize("workers", [0, 1, 2, 3])
def test_groups_keep_their_worlds_for_long_games_also_where_they_are_more_than_workers(workers):
    players = tuple(PlayerSettings(team, group=group) for team in ("blue", "red") for group in "123")
    config = duel(players=players, workers=replace(duel().workers, train=workers))
    assert not early_restarts(config, lasting(1500), 64)
    assert settles(config, 1500)
    alike = replace(config, deterministic=True, budget=configuration.Budget(steps=10**6))
    assert early_restarts(alike, lasting(1500), 64)
    assert not settles(alike, 1500)
    assert settles(alike, 64)


def test_what_is_prepared_tells_of_early_restarts(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    training = replace(duel().training, worlds=8, rollout_length=4, iterations_per_turn=2)
    config = duel(deterministic=True, training=training, budget=configuration.Budget(steps=1000))
    (line,) = prepare(RunSpec.of("store", config), config).starts
    assert "every turn, after 8 decisions" in line


@pytest.mark.parametrize(
    ("schedule", "span", "mend"),
    [
        (Schedule("leapfrog", period=40), "1,920", "period = 63"),
        (Schedule("leapfrog", period_steps=99_999), "1,563", "193536"),
    ],
)
def test_phases_of_leapfrog_that_are_shorter_than_games_are_told_where_there_is_a_history(schedule, span, mend):
    training = replace(duel().training, rollout_length=48, schedule=schedule)
    config = duel(training=replace(training, opponents=Opponents("uniform", past=0.5)))
    (line,) = early_restarts(config, lasting(1500), 64)
    assert f"every phase, after {span} decisions" in line
    assert f"{mend} or more" in line
    assert not early_restarts(config, lasting(1042), 64)
    assert not early_restarts(duel(training=training), lasting(1500), 64)  # the newest opponents alone


@pytest.mark.parametrize(
    ("schedule", "span", "mend"),
    [
        (Schedule("ladder", period=40), "1,920", "schedule.period = 63"),
        (Schedule("ladder", period_steps=99_999), "1,563", "schedule.period_steps = 193536"),
    ],
)
def test_phases_of_ladder_that_are_shorter_than_games_are_told(schedule, span, mend):
    config = duel(training=replace(duel().training, rollout_length=48, schedule=schedule))
    (line,) = early_restarts(config, lasting(1500), 64)
    assert f"in ladder worlds begin anew every phase, after {span} decisions" in line
    assert f"{mend} or more" in line
    assert not early_restarts(config, lasting(1042), 64)


def test_scripts_by_which_training_ends_are_in_the_pool_whatever_is_rated():
    config = duel(rating=replace(duel().rating, scripts=("random",)))
    assert scripts(config, validate(config)) == ("random",)
    config = replace(config, budget=configuration.Budget(score=0.8, against=("idle",)))
    assert scripts(config, validate(config)) == ("random", "idle")


def test_more_devices_than_gpus_are_refused_and_on_a_cpu_they_are_processes(monkeypatch):
    def spread(count: int) -> configuration.Config:
        return configuration.loads(f'arena.name = "rock-paper-scissors"\n[training]\ndevices = {count}\n')

    def gpus(names: str) -> None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", names)
        devices.gpus.cache_clear()

    try:
        gpus("2,5")
        assert validate(spread(2)).name == "rock-paper-scissors"
        with pytest.raises(ConfigError, match=r"^training\.devices = 3: the GPUs .* here are 2, .*; use 2 or less$"):
            validate(spread(3))
        gpus("")
        assert validate(spread(3)).name == "rock-paper-scissors"
        assert worlds(spread(3)) % 3 == 0
    finally:
        devices.gpus.cache_clear()


def test_ladder_needs_equal_rosters_and_equal_networks():
    def ladder(arena: str, more: str = "") -> configuration.Config:
        return configuration.loads(f'arena.name = "{arena}"\n[training.schedule]\nkind = "ladder"\n{more}')

    with pytest.raises(ConfigError) as caught:
        validate(ladder("sumo-by-team"))
    assert str(caught.value) == (
        'training.schedule.kind = "ladder": what blue (anymal:56:12+anymal:56:12) learns cannot be copied to red'
        " (leatherback:14:2+leatherback:14:2): ladder needs equal rosters; use simultaneous, leapfrog or frozen"
    )
    players = '[[players]]\nteam = "blue"\n[[players]]\nteam = "red"\n'
    assert validate(ladder("sumo-1v1", f"{players}hidden = [64, 64]\n")).name == "sumo-1v1"
    with pytest.raises(ConfigError, match=r"^players\[1\]\.hidden = \[8\]: .* blue .* \[64, 64\]; give both the same$"):
        validate(ladder("sumo-1v1", f"{players}hidden = [8]\n"))


@pytest.mark.parametrize(
    ("sees", "fits", "not_in", "says"),
    [
        ("all", "rock-paper-scissors", f"{ROOT}/tests/arenas/solo.py:solo", "has one team.*; use own$"),
        ("same", "rock-paper-scissors", f"{ROOT}/tests/arenas/solo.py:solo", "has one team.*; use own$"),
        ("privileged", f"{ROOT}/tests/arenas/solo.py:solo", "rock-paper-scissors", "has no bodies.*; use own or all$"),
    ],
)
def test_what_a_critic_is_to_see_must_be_there(sees, fits, not_in, says):
    def seeing(arena: str) -> configuration.Config:
        return configuration.loads(f'arena.name = "{arena}"\n[learner]\ncritic_input = "{sees}"\n')

    assert validate(seeing(fits)).name == fits
    with pytest.raises(ConfigError, match=rf"learner\.critic_input = \"{sees}\": .* {says}"):
        validate(seeing(not_in))


def test_a_refused_league_leaves_nothing_and_a_good_one_is_whole(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    players = (
        PlayerSettings("blue"),
        PlayerSettings("blue", hidden=(8,)),
        PlayerSettings("red"),
        PlayerSettings("red"),
    )
    config = duel(players=players)
    refused = replace(config, players=(PlayerSettings("green"),))
    with pytest.raises(ConfigError, match="the arena's teams are") as caught:
        prepare(RunSpec.of("store", refused), refused)
    assert caught.value.key == ("players", "0", "team")
    assert not list(tmp_path.iterdir())

    arena = validate(config)
    with Store.open("store", create=True) as store:
        create(store, config, arena)
        assert configuration.loads(store.league("duel").config) == config
        assert [(p.name, p.team, p.group) for p in store.players("duel")] == [
            ("blue", 0, "1"), ("blue-2", 0, "2"), ("red", 1, "1"), ("red-2", 1, "2"),
        ]  # fmt: skip
        assert {s.name for s in store.snapshots("duel")} == {"idle", "random", "pusher", "centre-holder"}
        before = store.revision("duel")
        create(store, config, arena)
        assert store.revision("duel") == before
        with pytest.raises(ConfigError, match=r"players that the settings do not name \(blue-2, red-2\)"):
            create(store, replace(config, players=()), arena)


@pytest.mark.parametrize(
    ("league", "a", "b", "key"),
    [
        ("", "", "training.schedule.learner = 2", ("stages", "1", "training", "schedule", "learner")),
        ("training.schedule.learner = 2", "training.schedule.learner = 0", "", ("training", "schedule", "learner")),
    ],
    ids=["in the stage", "above the stages"],
)
def test_what_the_arena_of_a_stage_cannot_do_names_the_stage_and_where_it_was_said(league, a, b, key, tmp_path):
    stages = f"[[stages]]\nname = 'a'\nbudget.steps = 8\n{a}\n[[stages]]\nname = 'b'\n{b}\n"
    spec = RunSpec.of(
        str(tmp_path / "store"), configuration.loads(f"arena.name = 'matching-pennies'\n{league}\n{stages}")
    )
    request = {"spec": asdict(spec), "parent": os.getppid(), "create": True, "imported": ()}
    with pytest.raises(
        ConfigError, match=r"^stage b: training\.schedule\.learner = 2: the arena's teams are"
    ) as caught:
        preflight._prepare(request, None)
    assert caught.value.key == key
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arena", "changes", "found"),
    [
        ("block-push-anymal", {}, {"anymal-push"}),
        ("block-push-anymal", {"trained": False}, set()),
        ("block-push-leatherback", {}, {"leatherback-push"}),
        ("sumo-1v1", {}, set()),
    ],
)
def test_policies_that_come_with_the_league_are_in_the_pool_of_their_arena(arena, changes, found, tmp_path):
    config = configuration.default(arena)
    config = replace(config, rating=replace(config.rating, **changes))
    with Store.open(tmp_path, create=True) as store:
        for _ in range(2):  # as at every start
            create(store, config, config.arena.build(engine="c"))
        assert {s.name for s in store.snapshots(config.league) if s.origin == "imported"} == found


def test_where_nobody_is_named_each_team_has_a_main_player():
    assert [(p.name, p.role, p.group) for p in roster(duel(), ["blue", "red"])] == [
        ("blue", "main", "1"), ("red", "main", "1"),
    ]  # fmt: skip


def test_the_number_of_worlds_suits_the_device_unless_it_is_given():
    import jax

    assert worlds(duel()) == (2048 if jax.default_backend() == "gpu" else 256)
    assert worlds(duel(training=replace(duel().training, worlds=10))) == 10


@pytest.mark.parametrize(
    ("body", "says"),
    [
        ("raise RuntimeError('at once')\n", "RuntimeError: at once (own.py:1)"),
        ("import sys\nsys.exit(3)\n", "it exits with 3 (own.py:2)"),
        ("def broken(:\n", "SyntaxError: invalid syntax (own.py:1)"),
    ],
)
def test_an_arena_file_that_cannot_be_read_is_told_with_its_line(body, says, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("own.py").write_text(body)
    with pytest.raises(ConfigError) as caught:
        configuration.default("own.py:own")
    assert says in str(caught.value)


OWN_ARENA = """
from dataclasses import dataclass
from tests.arenas.race import Race, RaceSettings

class Own(Race):
    def observe(self, physics, game, actions):
        return {{{name}: {numbers} for name, numbers in super().observe(physics, game, actions).items()}}

@dataclass(frozen=True)
class OwnSettings(RaceSettings):
    name: str = "own"

    def build(self, **where):
        return Own(self, **where)

ARENAS = (OwnSettings(),)
"""


@pytest.mark.parametrize(("name", "numbers", "says"), [
    ("name", "numbers[:5]", "the observation of blue/0 is float32 (5,), not float32 (6,)"),
    ("name[1:]", "numbers", "observations are of ['ed/0', 'lue/0'], agents are ['blue/0', 'red/0']"),
    ("name", "numbers", ""),
])  # fmt: skip
def test_an_own_arena_of_wrong_shapes_is_refused_in_one_line_before_there_is_a_store(
    name, numbers, says, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    Path("own.py").write_text(OWN_ARENA.format(name=name, numbers=numbers))
    config = configuration.default("own.py:own")
    if not says:
        assert validate(config).name == "own.py:own"
        return
    with pytest.raises(ConfigError) as caught:
        prepare(RunSpec.of("store", config), config)
    assert caught.value.message == f"arena own.py:own: {says}; `league check own.py:own` examines it"
    assert [path.name for path in tmp_path.iterdir() if path.name != "__pycache__"] == ["own.py"]


LIGHT = """
import resource, sys
from pathlib import Path
import league.commands.cli, league.commands.run.run, league.commands.run.background
import league.runtime.manager, league.runtime.preflight
from league.config import experiment as configuration, presets
for name in presets.PRESETS:
    assert configuration.loads(configuration.dumps(presets.preset(name))) == presets.preset(name)
heavy = {"torch", "jax", "mujoco", "warp"} & set(sys.modules)
status = Path("/proc/self/status")  # the other figure begins with what the process held that started this one
lines = status.read_text().splitlines() if status.exists() else []
peak = next((line.split()[1] for line in lines if line.startswith("VmHWM")), 0)
print(",".join(sorted(heavy)), (int(peak) or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss) // 1024, sep=";")
"""


def test_configuration_and_manager_load_nothing_heavy():
    done = subprocess.run([sys.executable, "-c", LIGHT], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    heavy, megabytes = done.stdout.strip().split(";")
    assert heavy == ""
    assert int(megabytes) < 300


def test_a_victim_must_be_there_or_come_with_the_league(tmp_path):
    from league.runtime.bootstrap import validate_victims

    arena = configuration.default("matching-pennies").arena.build()

    def always(victim: str) -> configuration.Config:
        text = f'arena.name = "matching-pennies"\n[training.opponents]\nkind = "fixed"\nvictim = "{victim}"\n'
        return configuration.loads(text)

    place = str(tmp_path / "new")
    for victim in ("heads:blue", "random:red", "red@0"):
        validate_victims(place, always(victim), arena)
    with pytest.raises(ConfigError, match=r'victim = "heads": .* there are: heads:blue') as caught:
        prepare(RunSpec.of(place, always("heads")), always("heads"))
    assert caught.value.key == ("training", "opponents", "victim")
    assert not (tmp_path / "new").exists()


def test_without_a_compiler_nothing_is_compiled(monkeypatch, tmp_path):
    config = configuration.loads('arena.name = "rock-paper-scissors"\n[learner]\ncompiled = true\n')
    for name in ("CC", "CXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"^learner\.compiled = true: .* a C\+\+ compiler, .*; use false$"):
        validate(config)
