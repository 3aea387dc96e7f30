"""The tutorials of docs/environments.md run as they stand there, with fewer worlds, decisions and episodes."""

import re
import shlex
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import league
from agents.policy.networks import Actor
from agents.settings import Architecture
from league.commands import cli
from league.config.presets import preset
from league.snapshots.codec import freeze
from storage.records import League, Player, Snapshot
from storage.store import Store

PAGE = Path(__file__).parents[2] / "docs" / "environments.md"


def blocks(tutorial: str) -> list[str]:
    """The code of a tutorial, block by block."""
    return re.findall(rf"<!-- tutorial: {tutorial} -->\n```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)


def commands(tutorial: str) -> list[list[str]]:
    """The words of a tutorial's commands, without `league`."""
    (block,) = re.findall(
        rf"<!-- tutorial: {tutorial}, at the command line -->\n```bash\n(.*?)```", PAGE.read_text(), re.S
    )
    return [shlex.split(line)[1:] for line in block.splitlines()]


def run(code: str, names: dict, **shorter: object) -> None:
    """Run a block with other values of its constants."""
    for name, value in shorter.items():
        code, found = re.subn(rf"^{name} = .*$", f"{name} = {value}", code, flags=re.MULTILINE)
        assert found == 1, name
    exec(compile(code, str(PAGE), "exec"), names)


@pytest.fixture
def duel(tmp_path, monkeypatch):
    """A folder with a store in which blue has a snapshot, as after the preset that the page runs."""
    (name,) = re.findall(r"`league run --preset (\S+)`", PAGE.read_text("utf-8"))
    config = preset(name)
    (blue, *_) = config.arena.build().teams
    torch.manual_seed(0)
    policies = []
    for agent in blue.agents:
        actor = Actor(agent.observation_size, agent.action_size, Architecture(hidden=(8,)), initial_std=0.5)
        policies.append({name: tensor.numpy() for name, tensor in actor.state_dict().items()})
    with Store.open(tmp_path / "league-data", create=True) as store:
        store.create_league(League(config.league, ""))
        store.add_players([Player(config.league, "blue", 0, "main", blue.roster)])
        digest = store.blobs.put(freeze(policies))
        store.add_snapshots([Snapshot(config.league, "blue@64", digest, blue.roster, "blue", iteration=64)])
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_a_rover_learns_by_the_ppo_of_another_library_and_becomes_a_file(duel, capsys):
    train, test, export = blocks("ppo")
    names: dict = {}
    train = train.replace("n_steps=64, batch_size=1024", "n_steps=16, batch_size=32")
    run(train, names, **{"WORLDS, DECISIONS": "2, 64"})
    assert names["learner"].num_timesteps == 64
    run(test, names, EPISODES=2)
    assert re.match(r"score [01]\.\d\d in \d+ episodes", capsys.readouterr().out)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch advises its exporter that needs onnxscript
        run(export, names)
    session = onnxruntime.InferenceSession(duel / "rover.onnx", providers=["CPUExecutionProvider"])
    seen = np.random.default_rng(0).normal(size=(3, 20)).astype(np.float32)
    (actions,) = session.run(["actions"], {"observations": seen})
    expected, _ = names["learner"].predict(seen, deterministic=True)
    np.testing.assert_allclose(actions, expected, atol=1e-5)

    bring, _ = commands("ppo")
    with pytest.raises(SystemExit, match=r"^0$"):
        cli.main(bring)
    assert "rover of league duel is rover.onnx (leatherback:20:2)" in capsys.readouterr().out
    assert league.opponent("league-data#rover").snapshot.origin == "imported"


@pytest.mark.slow
def test_a_loop_of_ones_own_plays_with_pettingzoo(capsys):
    (loop,) = blocks("pettingzoo")
    run(loop, {}, EPISODES=2)
    assert re.search(r"^1 \{'predators/0': [01]\.0", capsys.readouterr().out, re.MULTILINE)
