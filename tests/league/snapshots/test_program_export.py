"""A policy taken out of a league acts elsewhere as in the league: in ONNX, in TorchScript, in a card's NumPy."""

import io
import warnings
from types import SimpleNamespace

import jax
import numpy as np
import onnxruntime
import pytest
import torch
from safetensors.numpy import save_file

from agents.policy.constant_inputs import silence_constant_inputs
from agents.policy.host_policy import HostPolicy
from agents.policy.jax_policy import policy_params, stack_policies
from agents.policy.networks import Actor
from agents.rollout.rollout import make_play
from agents.settings import Architecture
from arenas.rosters import AgentSizes, roster_text
from league.snapshots.exports.networks import agents_of
from league.snapshots.exports.numpy_export import numpy_lines
from league.snapshots.exports.onnx_export import onnx_bytes
from league.snapshots.exports.torchscript_export import torchscript_bytes
from league.snapshots.programs.stored import host_policies, read
from tests.arenas.echo import EchoSettings
from tests.league.snapshots.scrambled import scrambled_arrays

KINDS = {
    "plain": {},
    "relu and LayerNorm": {"activation": "relu", "layer_norm": True},
    "squashed": {"activation": "elu", "squash": 1.5, "state_std": True},
    "recurrent": {"recurrent": 5},
    "a set": {"entities": 4},
    "a set and recurrent": {"entities": 3, "activation": "elu", "layer_norm": True, "recurrent": 5},
    "squashed, recurrent": {"recurrent": 6, "squash": 2.0, "layer_norm": True, "state_std": True},
}
ROSTER = roster_text([AgentSizes("listener", 2, 1)])
EACH = 8  # worlds of each kind


def scrambled(seed: int, **kind) -> dict[str, np.ndarray]:
    """A policy of which every number counts, those that normalise too."""
    torch.manual_seed(seed)
    sets = [[[0], [1]]] if "recurrent" not in kind else [[[1]]]  # without numbers of its own, or with one
    return scrambled_arrays(Actor(2, 1, Architecture((7, 6), **kind), 0.8, sets))


def described(own: dict[str, np.ndarray]) -> dict:
    (agent,) = agents_of({f"0/{name}": array for name, array in own.items()}, ROSTER)
    return agent


@pytest.fixture(scope="module")
def arena():
    return EchoSettings().build()


def played(arena, stack):
    """Whole episodes in EACH worlds of each kind: what was seen (T, kind, world, 2) and done (T, kind, world, 1)."""
    worlds = tuple(range(EACH * len(KINDS)))
    keys = jax.random.split(jax.random.key(3), len(worlds))
    games = jax.device_get(make_play(arena, worlds, seen=True)({"pupil/0": stack}, keys))
    seen, done = games.seen.observations["pupil/0"], games.actions["pupil/0"]
    start = jax.vmap(lambda key: jax.random.split(key, 2)[1])(keys)

    @jax.jit
    def drawn(t, key):
        return jax.random.normal(jax.random.fold_in(jax.random.fold_in(key, t), 0), (1,))

    noise = jax.vmap(lambda t: jax.vmap(lambda key: drawn(t, key))(start))(np.arange(len(seen)))

    def grouped(values) -> np.ndarray:
        return np.asarray(values).reshape(-1, len(KINDS), EACH, np.shape(values)[-1])

    return SimpleNamespace(seen=grouped(seen), done=grouped(done), noise=grouped(noise))


@pytest.fixture(scope="module")
def policies():
    return [scrambled(seed, **kind) for seed, kind in enumerate(KINDS.values())]


@pytest.fixture(scope="module")
def episodes(arena, policies):
    return played(arena, stack_policies([policy_params(own) for own in policies]))


def by_onnx(own, folder):
    session = onnxruntime.InferenceSession(onnx_bytes(own, described(own), {"name": "x"}))

    def act(seen, noise, memory):
        given = {"observations": seen, "noise": noise, "memory": memory}
        found = session.run(None, {each.name: given[each.name] for each in session.get_inputs()})
        return [*found, memory][:2]

    return act


def by_torchscript(own, folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        module = torch.jit.load(io.BytesIO(torchscript_bytes(own, described(own))))

    def act(seen, noise, memory):
        given = [torch.tensor(x) for x in ((seen, noise, memory) if "gru.weight_hh" in own else (seen, noise))]
        found = module(*given)
        return [x.detach().numpy() for x in found] if len(given) == 3 else [found.detach().numpy(), memory]

    return act


def by_numpy(own, folder, silenced=False):
    save_file({f"0/{name}": array for name, array in own.items()}, folder / "x.safetensors")
    lines, names = numpy_lines(described(own), 0, str(folder / "x.safetensors"), silenced), {}
    exec("\n".join(lines), names)

    def act(seen, noise, memory):
        return names["act"](seen, memory, noise) if "gru.weight_hh" in own else [names["act"](seen, noise), memory]

    return act


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
@pytest.mark.parametrize("kind", ["plain", "recurrent"])
def test_a_module_keeps_no_graph_of_what_it_did(kind):
    own = scrambled(1, **KINDS[kind])
    module = torch.jit.load(io.BytesIO(torchscript_bytes(own, described(own))))
    memory = [torch.zeros(2, module.memory_size)] if kind == "recurrent" else []
    found = module(torch.ones(2, 2), torch.zeros(2, 1), *memory)
    assert not any(each.requires_grad for each in (found if memory else [found]))


@pytest.mark.parametrize("taken", [by_onnx, by_torchscript, by_numpy])
def test_an_exported_policy_acts_as_in_the_league_over_whole_episodes(taken, policies, episodes, tmp_path):
    for kind, own in enumerate(policies):
        act = taken(own, tmp_path)
        memory = np.zeros((EACH, described(own).get("recurrent", 0)), np.float32)
        for seen, noise, done in zip(
            *(x[:, kind] for x in (episodes.seen, episodes.noise, episodes.done)), strict=True
        ):
            actions, memory = act(seen, noise, memory)
            np.testing.assert_allclose(actions, done, atol=1e-5)
    assert np.abs(episodes.done).max() > 1


@pytest.mark.parametrize("still", [[0], [1], [0, 1]])
def test_lines_for_another_arena_act_as_the_policy_does_there(still, policies, tmp_path):
    """Whatever of an observation was constant: a number of its own, a member of a set, a whole set."""
    rng = np.random.default_rng(0)
    for own in policies:
        own = {**own, "trunk.observation_var": own["trunk.observation_var"].copy()}
        own["trunk.observation_var"][still] = 1e-8
        seen, noise = (rng.normal(size=(16, size)).astype(np.float32) for size in (2, 1))
        memory = rng.normal(size=(16, described(own).get("recurrent", 0))).astype(np.float32)
        wanted = by_onnx(silence_constant_inputs(own), tmp_path)(seen, noise, memory)
        found = by_numpy(own, tmp_path, silenced=True)(seen, noise, memory)
        for each, other in zip(found, wanted, strict=True):
            np.testing.assert_allclose(each, other, atol=1e-5)
        assert np.abs(found[0] - by_numpy(own, tmp_path)(seen, noise, memory)[0]).max() > 0.01


def test_policies_that_left_and_came_back_play_the_same_episodes(arena, policies, episodes, tmp_path):
    back: list[HostPolicy] = []
    for number, own in enumerate(policies):
        path = tmp_path / f"{number}.file"
        as_onnx = number % 2 == 0
        path.write_bytes(onnx_bytes(own, described(own), {}) if as_onnx else torchscript_bytes(own, described(own)))
        kind = "onnx" if as_onnx else "torchscript"
        program, again = (read(kind, [str(path)], ROSTER) for _ in range(2))
        assert not program.singles
        assert program.to_bytes() == again.to_bytes()
        back += host_policies(program.to_bytes(), "twin")
    again = played(arena, stack_policies(back))
    np.testing.assert_allclose(again.seen, episodes.seen, atol=1e-6)
    np.testing.assert_allclose(again.done, episodes.done, atol=1e-5)
