"""Snapshots and policies' files as opponents in the environments of somebody else's learner."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch

import arenas
import league
from agents.policy.constant_inputs import is_constant
from agents.policy.networks import Actor
from agents.settings import Architecture
from arenas.errors import ArenaError
from league.snapshots import policy_file
from league.snapshots.codec import freeze
from storage.errors import StorageError
from storage.records import League, Player, Snapshot
from storage.store import Store
from tests.arenas.environments.programs import compilations

RACE = "tests/arenas/race.py:race"
PUCK = "puck:6:2"


def actor(bias: tuple[float, float], recurrent: int = 0) -> dict[str, np.ndarray]:
    """A policy that nearly always acts as told here, whatever it sees; a recurrent one as it remembers."""
    made = Actor(6, 2, Architecture(hidden=(8,), recurrent=recurrent), initial_std=1e-6)
    with torch.no_grad():
        if not recurrent:
            made.mean.weight.zero_()
        made.mean.bias.copy_(torch.tensor(bias))
    return {name: tensor.numpy() for name, tensor in made.state_dict().items()}


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A store with three policies of a puck: one pushes east, one west, one remembers; and a script."""
    folder = tmp_path_factory.mktemp("opponents") / "league-data"
    with Store.open(folder, create=True) as store:
        store.create_league(League("pucks", ""))
        store.add_players([Player("pucks", "red", 1, "main", PUCK)])
        blob = store.blobs.put
        policies = (actor((1.0, 0.0)), actor((-1.0, 0.0)), actor((0.0, 0.0), recurrent=4))
        store.add_snapshots([
            *(
                Snapshot("pucks", f"red@{i}", blob(freeze([policy])), PUCK, "red", iteration=i)
                for i, policy in enumerate(policies)
            ),
            Snapshot("pucks", "sprinter", blob(b"sprinter"), PUCK, script="sprinter", origin="scripted"),
        ])  # fmt: skip
    return str(folder)


def test_a_snapshot_plays_the_other_team_and_its_successor_needs_no_compilation(place):
    env = arenas.vector(RACE, "blue", league.opponent(f"{place}#red@0"), num_envs=2, threads=1)

    def red_moves(opponent=None):
        """The distance that red goes east in three decisions, as blue sees it; blue stands still."""
        before, _ = env.reset(seed=0, options={"opponent": opponent} if opponent else None)
        return [env.step(np.zeros((2, 2)))[0] for _ in range(3)][-1][:, 4] - before[:, 4]

    assert (red_moves() > 0.05).all()
    assert (red_moves(league.opponent(f"{place}#red@1")) < -0.05).all()
    assert compilations(env._shared.team_step(env._rows, env._opponent)) == 1


def test_a_recurrent_snapshot_remembers_through_an_episode_and_no_longer(place):
    arena = arenas.load(RACE, engine="c", threads=1)
    opponent = league.opponent(f"{place}#red").for_team(arena, arena.teams[1])
    keys, seen = jax.random.split(jax.random.key(0), 2), {"red/0": jnp.ones((2, 6))}

    @jax.jit
    def act(memory, first):
        return opponent.act(opponent.params, seen, keys, memory, first)

    one, memory = act(opponent.memory(2), jnp.array([True, True]))
    two, _ = act(memory, jnp.array([False, True]))
    assert memory["red/0"].shape == (2, 4)
    np.testing.assert_allclose(two["red/0"][1], one["red/0"][1], atol=1e-5)
    assert np.abs(two["red/0"][0] - one["red/0"][0]).max() > 1e-4


def test_a_script_of_a_league_plays_as_the_arenas_own(place):
    arena = arenas.load(RACE, engine="c", threads=1)
    opponent = league.opponent(f"{place}#sprinter").for_team(arena, arena.teams[1])
    keys, seen = jax.random.split(jax.random.key(0), 1), jnp.arange(6.0)[None]
    actions, _ = opponent.act((), {"red/0": seen}, keys, (), jnp.ones(1, bool))
    np.testing.assert_array_equal(actions["red/0"], 10.0 * seen[:, 2:4])


def test_a_file_plays_and_ignores_elsewhere_what_never_moved_where_it_learnt():
    arena = arenas.load("soccer-1v1", engine="c", threads=1)
    policy = policy_file.read(policy_file.find("anymal-score"))
    still, first_layer = is_constant(policy.arrays, "0/"), "trunk.hidden.0.weight"
    assert still.any()
    assert policy.arrays[f"0/{first_layer}"][:, still].any()
    opponent = league.opponent("anymal-score").for_team(arena, arena.teams[0])
    weights = np.asarray(opponent.params["blue/0"].parts[0][first_layer][0])
    assert not weights[:, still].any()
    np.testing.assert_array_equal(weights[:, ~still], policy.arrays[f"0/{first_layer}"][:, ~still])


def test_a_program_plays_and_what_it_remembers_is_of_the_episode(tmp_path):
    (tmp_path / "mine.py").write_text(
        "import numpy as np\n"
        "class Counting:\n"
        "    def __init__(self): self.n = 0\n"
        "    def reset(self): self.n = 0\n"
        "    def __call__(self, observation):\n"
        "        if observation.ndim > 1: raise ValueError('one world at a time')\n"
        "        self.n += 1\n"
        "        return np.array([self.n, 0.5], np.float32)\n"
    )
    arena = arenas.load(RACE, engine="c", threads=1)
    opponent = league.opponent(f"{tmp_path}/mine.py:Counting").for_team(arena, arena.teams[1])
    keys, seen = jax.random.split(jax.random.key(0), 2), {"red/0": jnp.ones((2, 6))}
    for first, expected in (([True, True], [1, 1]), ([False, False], [2, 2]), ([True, False], [1, 3])):
        actions, _ = opponent.act(opponent.params, seen, keys, opponent.memory(2), jnp.array(first))
        assert actions["red/0"].tolist() == [[n, 0.5] for n in expected]


def test_what_cannot_play_is_told_in_one_line(place):
    pushing = league.opponent("leatherback-push")
    with pytest.raises(
        ArenaError, match=r"^leatherback-push is a policy of leatherback:14:2, and team red of .*puck:6:2"
    ):
        arenas.vector(RACE, "blue", pushing)
    with pytest.raises(StorageError, match="no snapshot 'blue' here; there is: red@0"):
        league.opponent(f"{place}#blue")
    with pytest.raises(StorageError, match="no file or trained policy 'nobody' here"):
        league.opponent("nobody")
    with pytest.raises(StorageError, match="nowhere"):
        league.opponent("nowhere#blue")
