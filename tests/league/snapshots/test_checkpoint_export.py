"""`league export --checkpoint`: a player as it was saved last, with what it has learnt since its newest snapshot."""

from dataclasses import replace

import numpy as np
import pytest

from agents.learner.happo import HappoLearner
from agents.settings import Architecture, HappoConfig
from league.queries.query import Open
from league.snapshots import policy_file
from league.snapshots.codec import freeze
from storage.blobs import arrays
from storage.errors import StorageError, UnknownName
from storage.records import Checkpoint, Job
from storage.store import Store
from tests.league.snapshots.test_policy_file import KEY, league_at, ran

CONFIG = HappoConfig(Architecture((8, 4), "elu"), normalise_observations=True)


def learner(agents: int = 1, **further) -> HappoLearner:
    return HappoLearner([1] * agents, [3] * agents, replace(CONFIG, **further), seed=5)


def saved(store, state, iteration: int = 6):
    """Save blue's state after so many iterations, as a training turn does."""
    checkpoint = Checkpoint("home", "blue", store.blobs.put(arrays.to_bytes(state)), 1500, iteration, 90.0, KEY)
    store.queue([Job("home", "any", "turn")])
    claimed = store.claim("home", ["any"], "x", 60)
    assert claimed is not None
    store.finish(claimed[0], checkpoints=[checkpoint])


@pytest.fixture
def home(tmp_path):
    """The folder of a league whose newest snapshot of blue is of iteration 4."""
    league_at(tmp_path / "home", "home").close()
    return tmp_path / "home"


@pytest.mark.parametrize(("agents", "shared"), [(1, False), (2, False), (2, True)])
def test_it_is_the_policy_that_a_snapshot_would_have(agents, shared, tmp_path):
    made = learner(agents, share_actors=shared)
    frozen = freeze([{name: tensor.numpy() for name, tensor in each.items()} for each in made.export()])
    with league_at(tmp_path / "home", "home", "+".join(["chooser:1:3"] * agents)) as store:
        saved(store, made.save())
        policy = policy_file.export_checkpoint(Open(store, "home"), "blue")
    assert policy is not None
    assert policy.arrays.keys() == arrays.from_bytes(frozen).keys()
    for name, array in arrays.from_bytes(frozen).items():
        np.testing.assert_array_equal(policy.arrays[name], array, err_msg=name)
    about = policy.about
    assert (about["name"], about["steps"], about["seconds"], about["rating"]) == ("blue@6", 1500, 90.0, None)
    assert about["parents"] == ["blue@4", "blue@0"]
    assert len(about["agents"]) == agents


def test_the_command_writes_what_import_takes_and_a_card(home, tmp_path, capsys):
    with Store.open(home) as store:
        saved(store, learner().save())
    file = tmp_path / "blue.safetensors"
    said = ran(capsys, "export", "blue", "--checkpoint", "-o", str(file), "--store", str(home))
    assert said.startswith("Wrote blue@6 of league home to ")
    card = file.with_name(f"{file.name}.md").read_text()
    assert card.startswith("# blue@6 of league home\n")
    assert "6 iterations, 1,500 steps" in card
    assert "It has played no rating match." in card
    ran(capsys, "import", str(file), "--as", "guest", "--store", str(home))


def test_without_further_learning_it_is_the_newest_snapshot(home, tmp_path, capsys):
    with Store.open(home) as store:
        saved(store, learner().save(), iteration=4)
    file = tmp_path / "blue.safetensors"
    said = ran(capsys, "export", "blue", "--checkpoint", "-o", str(file), "--store", str(home))
    assert said.startswith("Wrote blue@4 of league home to ")
    with Store.open(home) as store:
        (newest,) = store.snapshots("home", named=["blue@4"])
    assert policy_file.read(file).about["digest"] == newest.digest


def test_what_is_no_player_or_no_network_is_refused(home, tmp_path, capsys):
    with Store.open(home) as store:
        saved(store, {"own.weights": np.zeros(3)})
        with pytest.raises(UnknownName, match="There is no player 'blue@4' here; there is: blue, red"):
            policy_file.export_checkpoint(Open(store, "home"), "blue@4")
        with pytest.raises(StorageError, match=r"checkpoint of blue is of a learner.*newest snapshot, blue@4"):
            policy_file.export_checkpoint(Open(store, "home"), "blue")
    said = ran(capsys, "export", "blue", "--checkpoint", "-o", str(tmp_path / "x"), "--store", str(home), code=2)
    assert "take its newest snapshot, blue@4" in said
    assert not (tmp_path / "x").exists()
