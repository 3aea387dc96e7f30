"""Learners of other classes in a league: the example of docs/learners.md, and what such a class may do wrong."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arenas
from agents.policy.host_policy import HostPolicy
from arenas.arena_settings import Table
from league.config import experiment
from league.config.build import build
from league.config.experiment import Config
from league.config.schema import ConfigError
from league.config.sections import PlayerSettings
from league.matches.evaluator import MatchEvaluator
from league.queries.query import Open
from league.runtime.validation import validate
from league.snapshots.policy_file import export
from league.state.jobs import RatingMatch
from league.training.own_learner import LearnerSource, OwnLearner
from league.training.setback import PlayerDiverged
from matchmaking.opponents import Opponents
from tests.league.turns import LEAGUE, claim, ends, new_store, new_trainer, settings, turns

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "docs" / "examples" / "reinforce.py"
GAME = arenas.settings("rock-paper-scissors")
ROCK = Opponents("fixed", victim="rock")


def of(where, opponents=Opponents(), **own):  # noqa: B008  (frozen)
    """The settings of a league of rock, paper, scissors whose players learn by the class at that place."""
    config = settings(opponents=opponents, device="cpu")
    learner = replace(config.learner, class_=str(where), settings=Table(own))
    return replace(config, arena=GAME, learner=learner)


def done(trainer, store, lease, turn):
    """Do a turn as a worker does it."""
    for _ in trainer.turn(store, turn, lambda: False):
        pass
    trainer.commit(store, lease, turn)


def against_rock(config, game, store, name):
    """The result of 64 episodes of a snapshot against the script rock."""
    rating = replace(config.rating, worlds=64, pairings=1)
    evaluator = MatchEvaluator(replace(config, rating=rating), game, LEAGUE)
    (match,) = evaluator.play(store, RatingMatch(((name, "rock"),), 5))
    return match


def written(folder, text):
    """The place of a class `Mine` in a file of its own, with the example to inherit from."""
    path = folder / "mine.py"
    path.write_text(f"from arenas import python_file\nfrom pathlib import Path\nimport numpy as np\nimport torch\n"
                    f"Reinforce = python_file(Path({str(EXAMPLE)!r})).Reinforce\n\n{text}")  # fmt: skip
    return f"{path}:Mine"


def test_the_example_is_as_short_as_said_and_learns_to_beat_a_script(store, game):
    assert len(EXAMPLE.read_text().splitlines()) <= 60
    config = of(f"{EXAMPLE}:Reinforce", ROCK, lr=0.3)
    turns(store, config, game, 11)  # iterations 1, 2, 4, 8, 12, ..., 40
    points = store.curves(LEAGUE, "blue")
    assert points[0].values["score"] < 0.7
    assert np.mean([p.values["score"] for p in points[-4:]]) > 0.97  # paper, nearly always
    newest = store.snapshots(LEAGUE, "blue")[-1]
    assert newest.iteration == 32
    assert against_rock(config, game, store, newest.name).wins > 60
    assert export(Open(store, LEAGUE), newest.name).about["agents"][0]["hidden"] == [16]


def test_a_worker_that_takes_over_goes_on_to_the_same_bytes(store, game, tmp_path):
    config = of(f"{EXAMPLE}:Reinforce", Opponents("uniform", past=0.5, groups=2))
    turns(store, config, game, 3)
    turns(store, config, game, 2)  # a fresh trainer, as after a kill
    with new_store(tmp_path / "other", game) as other:
        turns(other, config, game, 5)
        assert ends(other) == ends(store)
        kept = [{s.name: s.digest for s in each.snapshots(LEAGUE)} for each in (store, other)]
    assert {name: digest for name, digest in kept[0].items() if "@" in name} == kept[1]


def test_one_player_learns_by_a_class_and_the_other_by_happo(store, game):
    config = replace(of("happo"), players=(
        PlayerSettings("blue"), PlayerSettings("red", class_=f"{EXAMPLE}:Reinforce", settings=Table({"lr": 0.2})),
    ))  # fmt: skip
    turns(store, config, game, 3)
    assert {name: i for name, (i, _) in ends(store).items()} == {"blue": 2, "red": 2}
    assert "entropy" in store.curves(LEAGUE, "blue")[-1].values
    assert "return" in store.curves(LEAGUE, "red")[-1].values


ON_THE_HOST = """
class Mine(Reinforce):
    def act(self):
        return [self.draw]

    def draw(self, observations, noise, first):
        with torch.no_grad():
            policy = self.actors[0](torch.from_numpy(observations))
        return (policy.mean + policy.stddev * torch.from_numpy(noise)).numpy()
"""


def test_functions_act_on_the_host_and_the_past_as_arrays(store, game, tmp_path):
    """The example's own network, evaluated by torch, learns what it learns where the rollout evaluates it."""
    on_host = of(written(tmp_path, ON_THE_HOST), Opponents("uniform", past=0.5, groups=2))
    turns(store, on_host, game, 4)
    compiled = replace(on_host, learner=replace(on_host.learner, class_=f"{EXAMPLE}:Reinforce"))
    with new_store(tmp_path / "other", game) as other:
        turns(other, compiled, game, 4)
        mine, theirs = (each.curves(LEAGUE, "blue")[-1].values["return"] for each in (store, other))
    assert mine == pytest.approx(theirs, abs=0.05)


MEETS = """
class Mine(Reinforce):
    def meet(self, opponents):
        self.met = opponents

    def learn(self, batch):
        past = sum("@" in each for each in self.met)
        return {**super().learn(batch), "groups": len(self.met), "past": past, "red": self.met.count("red")}
"""


def test_a_learner_is_told_before_each_turn_whom_it_meets(store, game, tmp_path):
    turns(store, of(written(tmp_path, MEETS), Opponents("uniform", past=0.5, groups=2)), game, 4)
    told = store.curves(LEAGUE, "blue")[-1].values
    assert {name: told[name] for name in ("groups", "past", "red")} == {"groups": 2, "past": 1, "red": 1}


PROGRAMS = """
class Net(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.mean = torch.nn.Parameter(torch.zeros(3))

    def forward(self, observations, noise):
        return observations * self.mean + noise

class Mine:
    def __init__(self, agents, settings, seed, device):
        self.net = Net()

    def learn(self, batch):
        with torch.no_grad():
            self.net.mean += 0.1 * ((batch.actions[0] - self.net.mean) * batch.rewards[..., None]).mean((0, 1))

    def save(self):
        return {"mean": self.net.mean}

    def load(self, state):
        self.net.mean.data = torch.tensor(state["mean"])

    def export(self):
        return [torch.jit.trace(self.net, (torch.zeros(2, 1), torch.zeros(2, 3)))]
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_network_of_another_kind_is_kept_as_a_program_and_plays(store, game, tmp_path):
    config = of(written(tmp_path, PROGRAMS), ROCK)
    turns(store, config, game, 6)
    assert store.curves(LEAGUE, "blue")[-1].values["score"] > store.curves(LEAGUE, "blue")[0].values["score"]
    newest = store.snapshots(LEAGUE, "blue")[-1]
    match = against_rock(config, game, store, newest.name)
    assert match.wins + match.draws + match.losses == 64


REMEMBERS = """
class Count(torch.nn.Module):
    memory_size: int

    def __init__(self, weight: float):
        super().__init__()
        self.memory_size = 1
        self.weight = weight

    def forward(self, observations, memory):
        return (memory + self.weight).expand(observations.shape[0], 3), memory + 1.0

class Kept(torch.nn.Module):
    def __init__(self, weight: float):
        super().__init__()
        self.weight = weight
        self.register_buffer("count", torch.zeros(1, 1))

    def forward(self, observations):
        now = (self.count + self.weight).expand(observations.shape[0], 3)
        self.count += 1.0
        return now

class Mine:
    def __init__(self, agents, settings, seed, device):
        self.net, self.weight = {"Count": Count, "Kept": Kept}[settings["net"]], torch.zeros(1)

    def learn(self, batch):
        return {}

    def save(self):
        return {"weight": self.weight}

    def load(self, state):
        self.weight = torch.tensor(state["weight"])

    def export(self):
        return [torch.jit.script(self.net(float(self.weight)))]
"""


@pytest.mark.parametrize("net", ["Count", "Kept"])
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
def test_what_its_program_remembers_outlasts_the_rollouts_of_an_episode(game, tmp_path, net):
    """Its actions are the decisions since the episode began, plus the weight that it had learnt then."""
    learner = OwnLearner(
        "blue", LearnerSource(written(tmp_path, REMEMBERS), Table({"net": net}), game.teams[0], 1, "cpu")
    )

    def acted(policies, *first):
        (policy,) = policies
        assert isinstance(policy, HostPolicy)
        blank = np.zeros((2, 1), np.float32), np.zeros((2, 3), np.float32)
        return policy.act("chooser", 0, *blank, np.array(first, bool))[:, 0].tolist()

    assert [acted(learner.act(), True, True), acted(learner.act(), False, False)] == [[0, 0], [1, 1]]
    learner._learner.load({"weight": np.full(1, 100.0, np.float32)})  # as if it had learnt
    assert acted(learner.act(), False, True) == [102, 100]
    assert acted(learner.play(), False, False) == [103, 101]
    learner.load(learner.save())
    assert acted(learner.act(), False, False) == [100, 100]


FORGETS = """
class Mine(Reinforce):
    updates = 0

    def learn(self, batch):
        self.updates += 1
        return super().learn(batch)

    def save(self):
        return super().save() | {"updates": np.array(self.updates)}

    def load(self, state):
        super().load({name: value for name, value in state.items() if name != "updates"})
"""


@pytest.mark.parametrize(("text", "line"), [
    ("class Mine(Reinforce):\n    def learn(self, batch):\n        raise KeyError('gone')",
     r"red failed: .*mine\.py:Mine\.learn: KeyError: 'gone' \(mine\.py:9\)"),
    ("class Mine(Reinforce):\n    def learn(self, batch):\n        return {'loss': float('nan')}",
     r"red diverged: not finite: loss of .*mine\.py:Mine\.learn"),
    ("class Mine(Reinforce):\n    def learn(self, batch):\n        self.actors[0].mean.bias.data[:] = float('nan')",
     r"red diverged: not finite: mean\.bias of .*mine\.py:Mine\.export"),
    ("class Mine(Reinforce):\n    def act(self):\n        return [lambda *seen: 1 / 0]",
     r"red failed: .*mine\.py:Mine\.act: its function raised ZeroDivisionError: division by zero"),
    (FORGETS, r"red failed: .*mine\.py:Mine\.load: afterwards `save` gives something else \(updates\)"),
])  # fmt: skip
def test_a_learner_that_fails_is_one_line_and_a_setback_like_any_other(store, game, tmp_path, text, line):
    where = written(tmp_path, text)
    config = replace(of("happo"), players=(PlayerSettings("blue"), PlayerSettings("red", class_=where)))
    turns(store, config, game, 1)
    trainer = new_trainer(config, game, store)
    for _ in range(2):
        lease, turn = claim(store, config)
        with pytest.raises(PlayerDiverged, match=line) as error:
            done(trainer, store, lease, turn)
        assert "\n" not in str(error.value)
        store.record_setback(lease, error.value.player, str(error.value))
        trainer = new_trainer(config, game, store)
    red = next(p for p in store.players(LEAGUE) if p.name == "red")
    assert re.search(line, red.paused)
    turns(store, config, game, 2)
    assert {name: i for name, (i, _) in ends(store).items()}["blue"] > 0


@pytest.mark.parametrize(("text", "own", "line"), [
    (None, {}, r"learner\.class: blue failed: .*mine\.py:Mine: there is no file"),
    ("Mine = 3", {}, "there is no such class; the file defines no class"),
    ("class Mine(Reinforce):\n    export = None", {}, "has no method export: a learner has learn, save, load, export"),
    ("class Yours(Reinforce):\n    pass", {}, r"there is no such class; there is: Yours$"),
    ("Mine = Reinforce", {"rate": 0.1}, "ValueError: settings: rate is none of lr, gamma, hidden"),
    ("class Mine(Reinforce):\n    def export(self):\n        return [{'weight': np.zeros(3)}]", {},
     r"\.export: the state dict of agent 0 is not that of an Actor: agent 0 has no parameter activation"),
    ("class Mine(Reinforce):\n    def export(self):\n        return []", {},
     r"\.export: gives 0 policies for the 1 agents of blue"),
    ("class Mine(Reinforce):\n    def load(self, state):\n        self.actors[0].mean.bias.data += 1", {},
     r"\.load: afterwards `save` gives something else"),
    ("class Mine(Reinforce):\n    def load(self, state):\n        pass", {},
     r"\.load: afterwards `save` gives something else"),
    ("class Mine(Reinforce):\n    def save(self):\n        return {'name': 'text'}", {},
     r"\.save: TypeError: Array 'name' has type"),
    ("class Mine(Reinforce):\n    def save(self):\n        return {'adam': {'step': 1}}", {},
     r"\.save: TypeError: array 'adam' is a dict: give one flat dict"),
    ("class Mine(Reinforce):\n    def act(self):\n        return [lambda *seen: np.zeros((3, 7))]", {},
     r"\.act: for observations of zeros its function of agent 0 returned actions of shape \(3, 7\)"),
])  # fmt: skip
def test_what_no_league_can_use_is_refused_before_it_starts_in_one_line(tmp_path, text, own, line):
    where = written(tmp_path, text) if text else f"{tmp_path}/mine.py:Mine"
    with pytest.raises(ConfigError, match=line) as error:
        validate(of(where, **own))
    assert "\n" not in str(error.value)
    assert error.value.key == ("learner", "class")


@pytest.mark.parametrize(("flags", "line"), [
    ({"class": "mine"}, r"--learner\.class = \"mine\": must be happo, or a class in a file of yours"),
    ({"class": "my.py:Mine", "lr": "0.1"}, r"--learner\.lr = 0\.1: is a setting of happo, .* --learner\.settings\.lr"),
    ({"settings": "{lr = 1}"}, r"--learner\.settings = .*: are those of a class of yours; name it as learner\.class"),
])  # fmt: skip
def test_flags_that_do_not_fit_the_class_are_refused(flags, line):
    with pytest.raises(ConfigError, match=line):
        experiment.change(experiment.default(GAME.name), {("learner", name): text for name, text in flags.items()})


@pytest.mark.parametrize(("changes", "line"), [
    ({"training": {"devices": 2, "worlds": 16}}, r"training\.devices = 2: .* learns on one device; use 1"),
    ({"players": [{"team": "blue", "lr": 0.1}, {"team": "red"}]}, r"players\[0\]\.lr = 0\.1: is a setting of happo"),
    ({"after": ["leatherbacks-sumo"]}, "after: .* starts afresh, and takes over no networks"),
    ({"players": [{"team": "blue"}, {"team": "red", "after": ["leatherbacks-sumo"]}]},
     r"players\[1\]\.after: .* starts afresh"),
    ({"players": [{"team": "blue", "role": "pupil"}, {"team": "red"}],
      "roles": [{"name": "pupil", "timeout": 1000, "reset": "main"}]}, "only happo takes over"),
    ({"players": [{"team": "blue", "class": "happo"}, {"team": "red"}], "training": {"schedule": {"kind": "ladder"}}},
     "are of another class"),
])  # fmt: skip
def test_what_such_a_learner_cannot_do_is_refused_before_it_starts(changes, line):
    with pytest.raises(ConfigError, match=line):
        validate(build(Config, changes, of(f"{EXAMPLE}:Reinforce")))
