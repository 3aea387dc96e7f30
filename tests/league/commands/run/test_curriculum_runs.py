"""A curriculum: stages as settings, who starts from whom, and a walk that a kill does not stop."""

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig
from league.config import experiment as configuration
from league.config import presets
from league.config.schema import ConfigError
from league.scheduling import curriculum
from league.snapshots import policy_file
from league.snapshots.transfer import predecessors, warm_start
from league.snapshots.transfer.warm_start import IncompatiblePolicy, Source, WarmStart
from storage.blobs import arrays
from storage.errors import UnknownName
from storage.records import Player
from storage.store import Store
from tests.league.conftest import BODILESS, ROOT, call, said, start, wait_for

SOLO = f"{ROOT / 'tests' / 'arenas' / 'solo.py'}:solo"
WALK = f"""
league = "pucks"
arena.name = "{SOLO}"
training.worlds = 32
training.rollout_length = 16
training.iterations_per_turn = 4
rating.worlds = 16
rating.pairings = 2
rating.episodes_per_pair = 8
rating.final_episodes_per_pair = 8
rating.milestones = []
workers.nice = 0

[[stages]]
name = "near"
budget.steps = 4000

[[stages]]
name = "nearer"
arena.rules.reach = 0.25
budget.steps = 20_000
budget.rating_time = "60s"
"""


# Settings -------------------------------------------------------------------------------------------------------------


def test_a_stage_is_the_league_with_what_the_stage_says():
    config = configuration.loads(WALK)
    near, nearer = (configuration.stage(config, number) for number in (0, 1))
    assert (near.league, nearer.league) == ("pucks.near", "pucks.nearer")
    assert (near.after, nearer.after) == ((), ("pucks.near",))
    assert (near.arena.rules.reach, nearer.arena.rules.reach) == (0.3, 0.25)
    assert near.training == nearer.training == config.training
    assert (near.budget.steps, near.budget.rating_time) == (4000, "0s")  # who goes on need not wait for ratings
    assert (nearer.budget.steps, nearer.budget.rating_time) == (20_000, "60s")


def test_stages_are_written_as_they_are_read():
    for config in (configuration.loads(WALK), presets.preset("sumo-by-team"), presets.preset("sumo-within-team")):
        assert configuration.loads(configuration.dumps(config)) == config


def test_a_budget_of_the_whole_league_bounds_every_stage():
    config = presets.preset("sumo-by-team")
    short = replace(config, budget=replace(config.budget, steps=3000))
    assert {configuration.stage(short, number).budget.steps for number in range(4)} == {3000}
    assert configuration.stage(short, 0).budget.success == 0.9
    text = 'budget.steps = 3000\n[[stages]]\nname = "a"\nbudget.steps = "none"\nbudget.training_time = "1m"\n'
    assert configuration.stage(configuration.loads(f'{text}[[stages]]\nname = "b"\n'), 0).budget.steps == 3000


def test_worlds_given_as_a_flag_bound_every_stage_and_those_of_a_file_do_not():
    text, flag = 'preset = "soccer-1v1"\n', {("training", "worlds"): "16"}
    far = [each.name for each in presets.preset("soccer-1v1").stages].index("score-leatherback-far")
    few, many, over = (
        configuration.loads(text, given=flag), configuration.loads(text, given={("training", "worlds"): "4096"}),
        configuration.loads(text, over={"training": {"worlds": 16}}),
    )  # fmt: skip
    in_file = configuration.loads(f"{text}training.worlds = 16\n")
    for config, of_far, of_walk in (few, 16, 16), (over, 16, 16), (many, 2048, 4096), (in_file, 2048, 16):
        assert configuration.stage(config, far).training.worlds == of_far
        assert configuration.stage(config, 0).training.worlds == of_walk
    assert configuration.loads(configuration.dumps(few)) == few


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('[[stages]]\ntraining.rollout_length = 3\n', "league.toml:1: stages[0]: a stage needs a name, in quotes"),
        ('[[stages]]\nname = "a b"\n', 'league.toml:2: stages[0].name = "a b": a name is made of letters'),
        ('[[stages]]\nname = "a"\nseed = 3\n', "league.toml:3: stages[0].seed: is the same in all stages"),
        ('[[stages]]\nname = "a"\nbudget.stepps = 3\n', "league.toml:3: stage a: unknown key budget.stepps: did"),
        ('[[stages]]\nname = "a"\narena.name = "sumu"\n', "league.toml:3: stage a: unknown arena 'sumu'"),
        ('[[stages]]\nname = "a"\n[[stages]]\nname = "b"\n', "league.toml:1: stage a: nothing ends it; give it"),
        ('[[stages]]\nname = "a"\nbudget.steps = 1\n[[stages]]\nname = "a"\n', "stages: 2 are called a"),
        ("stages = 3\n", "league.toml:1: stages: expected a list of tables, each beginning with [[stages]]"),
        (
            '[[stages]]\nname = "a"\nlearner.architecture.hidden = [3]\n',
            "league.toml:3: stage a: learner.architecture: must be the same in all stages",
        ),
    ],
)  # fmt: skip
def test_stages_that_cannot_be_are_refused_in_one_line(text, says):
    with pytest.raises(ConfigError) as caught:
        configuration.loads(text)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


# Who starts from whom -------------------------------------------------------------------------------------------------

DOG, CAR = "anymal:56:12", "leatherback:14:2"


def player(league: str, name: str, team: int, roster: str) -> Player:
    return Player(league, name, team, "main", roster)


WALKED = [player("cup.walk", "blue", 0, DOG)]
PUSHED = [player("cup.dogs", "blue", 0, DOG), player("cup.dogs", "red", 1, DOG)]
DROVE = [player("cup.cars", "blue", 0, CAR), player("cup.cars", "red", 1, CAR)]


def test_an_agent_goes_on_from_its_own_kind_of_the_nearest_league():
    match = [player("cup.match", "blue", 0, f"{DOG}+{DOG}"), player("cup.match", "red", 1, f"{CAR}+{CAR}")]
    found = warm_start.warm_starts(match, [DROVE, PUSHED, WALKED])
    assert found == {
        "blue": WarmStart((Source("cup.dogs", "blue", 0), Source("cup.dogs", "red", 0)), None),
        "red": WarmStart((Source("cup.cars", "blue", 0), Source("cup.cars", "red", 0)), None),
    }
    told = warm_start.describe(found)
    assert told[0].startswith("blue: actors go on from cup.dogs's blue/0, cup.dogs's red/0; critic starts afresh")


def test_a_critic_goes_on_where_its_input_fits():
    assert warm_start.warm_starts(PUSHED, [WALKED]) == {
        name: WarmStart((Source("cup.walk", "blue", 0),), ("cup.walk", "blue")) for name in ("blue", "red")
    }


def test_a_critic_of_all_teams_goes_on_where_all_rosters_are_the_same():
    assert warm_start.warm_starts(PUSHED, [WALKED], "all") == {
        name: WarmStart((Source("cup.walk", "blue", 0),), None) for name in ("blue", "red")
    }
    again = [player("cup.again", p.name, p.team, p.roster) for p in PUSHED]
    assert [found.critic for found in warm_start.warm_starts(again, [PUSHED], "all").values()] == [
        ("cup.dogs", "blue"), ("cup.dogs", "red")
    ]  # fmt: skip


def test_a_common_critic_goes_on_among_the_same_teams_and_one_of_the_whole_state_in_no_other_league():
    again = [player("cup.again", p.name, p.team, p.roster) for p in PUSHED]
    for sees, found in (("same", [("cup.dogs", "blue"), ("cup.dogs", "red")]), ("privileged", [None, None])):
        assert [found.critic for found in warm_start.warm_starts(again, [PUSHED], sees).values()] == found
        assert {found.critic for found in warm_start.warm_starts(PUSHED, [WALKED], sees).values()} == {None}


def test_who_has_no_forerunner_starts_afresh_and_that_is_said():
    found = warm_start.warm_starts(DROVE, [PUSHED, WALKED])
    assert set(found.values()) == {WarmStart((None,), None)}
    assert warm_start.describe(found) == [
        f"{name}: actors start afresh; critic starts afresh" for name in ("blue", "red")
    ]


@pytest.fixture
def store(tmp_path):
    with Store.open(tmp_path, create=True) as store:
        yield store


def test_a_policy_that_comes_with_the_league_is_a_forerunner(store):
    policy = policy_file.read(policy_file.find("anymal-push"))
    (pushed,), again = predecessors.forerunners(store, ["anymal-push"]), player("new", "blue", 0, DOG)
    assert pushed[0].roster == DOG
    (found,) = warm_start.of(store, [again], ["anymal-push"]).values()
    assert found == WarmStart((Source("anymal-push", policy.about["name"], 0),), None)
    theirs = HappoLearner(
        (56,), (12,), HappoConfig(Architecture((128, 128, 128), "elu"), normalise_observations=True), 1
    )
    ours, name = theirs.save(), warm_start.start(store, theirs, found)
    assert name == f"anymal-push/{policy.about['name']}"
    for key, array in theirs.export()[0].items():
        np.testing.assert_array_equal(array, policy.arrays[f"0/{key}"], err_msg=key)
    now = theirs.save()
    stood = policy.arrays["0/trunk.observation_var"] < 1e-6
    np.testing.assert_array_equal(now["actor.0.observed"], np.where(stood, 0, policy.about["steps"]))
    assert not now["critic.observed"].any()
    np.testing.assert_array_equal(now["critic.value.weight"], ours["critic.value.weight"])


def test_what_stood_still_in_a_stage_says_nothing_at_first_in_the_next(store):
    """An ANYmal that scores has met no enemy; all that it has seen move it goes on with."""
    policy = policy_file.read(policy_file.find("anymal-score"))
    (found,) = warm_start.of(store, [player("new", "blue", 0, policy.about["roster"])], ["anymal-score"]).values()
    theirs = HappoLearner(
        (66,), (12,), HappoConfig(Architecture((128, 128, 128), "elu"), normalise_observations=True), 1
    )
    warm_start.start(store, theirs, found)
    stood = policy.arrays["0/trunk.observation_var"] < 1e-6
    assert set(range(57, 66)) <= set(np.flatnonzero(stood)) < set(range(45, 66))  # team-mate and enemies, at least
    now, name = theirs.export()[0], "trunk.hidden.0.weight"
    np.testing.assert_array_equal(now[name], np.where(stood, 0.0, policy.arrays[f"0/{name}"]))
    assert set(now["trunk.observation_var"][stood].tolist()) == {1.0}


def test_who_should_go_on_from_nothing_that_is_there_is_told_what_is(store):
    with pytest.raises(UnknownName, match=r"no league or trained policy 'anymal-psh' here.*mean 'anymal-push'"):
        predecessors.forerunners(store, ["anymal-psh"])


def test_a_policy_of_other_numbers_is_refused():
    with pytest.raises(
        IncompatiblePolicy, match=r"anymal sees 106 numbers and acts with 12 here, and sees 56 .* cup\.walk"
    ):
        warm_start.warm_starts([player("cup.dogs", "blue", 0, "anymal:106:12")], [WALKED])


def learner(sizes: tuple[int, ...], seed: int) -> HappoLearner:
    return HappoLearner(sizes, (2,) * len(sizes), HappoConfig(Architecture((8,)), normalise_observations=True), seed)


def test_a_learner_inherits_actors_with_their_deviations_and_leaves_the_rest():
    given, own = learner((3, 3), 1), learner((3, 3), 2)
    before, theirs = own.save(), given.save()
    theirs["actor.1.std_logit"] = theirs["actor.1.std_logit"] + 0.25
    own.warm_start([(theirs, 1), None], None)
    after = own.save()
    for name in (name for name in after if name.startswith("actor.0.")):
        np.testing.assert_array_equal(after[name], theirs[name.replace(".0.", ".1.", 1)])
    changed = {name for name in after if not np.array_equal(after[name], before[name])}
    assert changed
    assert all(name.startswith("actor.0.") for name in changed)


def test_a_learner_inherits_a_critic_with_its_value_normaliser():
    given, own = learner((3,), 1), learner((3,), 2)
    theirs = given.save() | {"value_norm.mean_sum": given.save()["value_norm.mean_sum"] + 3}
    own.warm_start([(theirs, 0)], theirs)
    kept = {k: v for k, v in own.save().items() if not k.startswith(("adam", "rng"))}
    for name, array in kept.items():
        np.testing.assert_array_equal(array, theirs[name])


@pytest.mark.parametrize("layer_norm", [False, True])
def test_what_never_moved_elsewhere_says_nothing_until_it_is_learnt(layer_norm: bool):
    """While it rests the policy is the same; else it was a new one as soon as an enemy came into sight."""
    config = HappoConfig(Architecture((8,), layer_norm=layer_norm), normalise_observations=True)
    given, own = (HappoLearner((4,), (2,), config, seed) for seed in (1, 2))
    theirs = given.save()
    theirs["actor.0.trunk.observation_mean"] = np.array([0.5, 0, 2, -1], np.float32)
    theirs["actor.0.trunk.observation_var"] = np.array([4, 0, 1e-12, 0.25], np.float32)  # the middle two never moved
    theirs["actor.0.trunk.observation_clip"] = np.array(10, np.float32)
    given.load(theirs)
    own.warm_start([(theirs, 0)], None, from_other_arena=True)

    def means(learner: HappoLearner, *resting: float) -> np.ndarray:
        seen = torch.tensor([[1.0, *resting, 0.3], [-2.0, *resting, -1.0]])
        return learner.actors[0](seen).mean.detach().numpy()

    np.testing.assert_allclose(means(own, 0.0, 2.0), means(given, 0.0, 2.0), atol=1e-6)
    moved, unheard = (np.abs(means(x, 3.0, -1.0) - means(x, 0.0, 2.0)).max() for x in (given, own))
    assert moved > 1e-4
    assert layer_norm or unheard == 0.0  # behind a LayerNorm each input moves all
    np.testing.assert_array_equal(own.save()["actor.0.trunk.observation_var"], np.array([4, 1, 1, 0.25], np.float32))


def test_a_policy_of_another_network_is_not_inherited():
    with pytest.raises(ValueError, match="does not fit"):
        learner((3,), 2).warm_start([(learner((4,), 1).save(), 0)], None)


# The walk -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_curriculum_is_walked_and_a_kill_amid_a_stage_costs_nothing(tmp_path, capsys):
    (tmp_path / "pucks.toml").write_text(WALK)
    first = start("run", "pucks.toml", "--workers.match", "0", cwd=tmp_path)
    wait_for(tmp_path, lambda store: [c for c in store.newest_checkpoints("pucks.nearer").values() if c.iteration > 4])
    first.send_signal(signal.SIGKILL)
    first.wait()
    again = call("run", "--workers.match", "1", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "Stage 2 of 2, nearer: it ends after 20,000 steps" in again.stdout
    assert "Stage 1" not in again.stdout

    begun = (tmp_path / "out.txt").read_text()
    assert "Stage near has ended: 4,096 steps of 4,000 steps." in begun
    assert "runner: actors go on from pucks.near's runner/0; critic and value normaliser from pucks.near's" in begun
    with Store.open(tmp_path / "league-data") as store:
        near, initial = (
            arrays.from_bytes(store.blobs.get(digest))
            for digest in (
                store.newest_checkpoints("pucks.near")["runner"].digest,
                store.snapshots("pucks.nearer", "runner")[0].digest,
            )
        )
        for name in (name for name in initial if "activation" not in name):
            np.testing.assert_array_equal(initial[name], near[f"actor.{name.replace('/', '.')}"])
        assert store.snapshots("pucks.nearer", "runner")[0].parent == "pucks.near/runner@8"
        assert store.newest_checkpoints("pucks.nearer")["runner"].step >= 20_000
        lines = curriculum.report(curriculum.read_stages(store, "pucks.nearer"))
    assert lines == [
        "1. near: has ended: 4,096 steps of 4,000 steps", "2. nearer: has ended: 20,480 steps of 20,000 steps"
    ]  # fmt: skip

    def told(*args: str) -> str:
        code, out, err = said(capsys, *args, "--store", str(tmp_path / "league-data"))
        assert code == 0, err
        return out

    assert "1. near: has ended" in told("status")
    assert told("snapshots", "--league", "pucks").count("runner@0") == 1
    assert told("snapshots", "--league", "pucks") == told("snapshots")
    over = call("run", "--seed", "12345", cwd=tmp_path)
    assert over.returncode == 0
    assert "The last stage of league pucks has ended" in over.stdout
    assert "keeps the settings of its last run, and these are not used: seed 1 -> 12345." in over.stdout
    assert "Goes on with other settings" not in over.stdout


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_sumo_by_team_is_walked_from_the_first_step_to_the_matches(tmp_path):
    done = call(
        "run", "--preset", "sumo-by-team", "--steps", "2000", "--training.worlds", "32",
        "--training.rollout_length", "16", "--workers.match", "0", "--workers.nice", "0",
        "--budget.rating_time", "0s", cwd=tmp_path, timeout=1700,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for number, name in enumerate(("walk", "push-anymal", "push-leatherback", "match"), 1):
        assert f"Stage {number} of 4, {name}" in done.stdout
    match = "blue: actors go on from sumo-by-team.push-anymal's blue/0, sumo-by-team.push-anymal's red/0"
    assert match in done.stdout
    with Store.open(tmp_path / "league-data") as store:
        assert {p.roster for p in store.players("sumo-by-team.match")} == {
            "anymal:56:12+anymal:56:12", "leatherback:14:2+leatherback:14:2"
        }  # fmt: skip
        assert not store.jobs("sumo-by-team.match", "failed")
        assert min(c.step for c in store.newest_checkpoints("sumo-by-team.match").values()) >= 2000


@pytest.mark.slow
def test_a_league_starts_from_a_file_and_needs_it_no_more_once_it_has_begun(bodiless_league, tmp_path):
    file, store = tmp_path / "mine.safetensors", str(bodiless_league / "league-data")
    exported = call("export", "blue", "--store", store, "-o", str(file), cwd=tmp_path)
    assert exported.returncode == 0, exported.stderr
    rest = ("--steps", "4096", "--budget.rating_time", "0s", "--workers.match", "0")
    first = call("run", *BODILESS, *rest, "--after", file.name, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert f"red: actors go on from {file.name}'s blue@4/0; critic starts afresh" in first.stdout
    with Store.open(tmp_path / "league-data") as begun:
        assert begun.snapshots("tiny", "blue")[0].digest == policy_file.read(file).about["digest"]
    file.unlink()
    again = call("run", *rest, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
