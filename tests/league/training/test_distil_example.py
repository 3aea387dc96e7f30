"""The learner of docs/examples/distil.py: which teachers it takes, and by which statistics its students normalise."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from agents.policy.networks import Actor
from agents.policy.skill_arrays import Skill, skill_arrays
from agents.settings import Architecture
from arenas import python_file
from arenas.rosters import AgentSizes, roster_text
from league.snapshots.exports.networks import agents_of
from league.snapshots.exports.torchscript_export import torchscript_bytes

Distil = python_file(Path(__file__).parents[3] / "docs" / "examples" / "distil.py").Distil
SEES, ACTS = 4, 2
AGENTS = [SimpleNamespace(name=f"blue/{i}", kind="puck", observation_size=SEES, action_size=ACTS) for i in range(2)]


def network(**kind) -> dict[str, np.ndarray]:
    torch.manual_seed(0)
    return {k: v.numpy() for k, v in Actor(SEES, ACTS, Architecture((8,), **kind), 0.5).state_dict().items()}


def teacher(file: Path, own: dict[str, np.ndarray]) -> str:
    """The TorchScript file of a policy, as `league export` writes it."""
    roster = roster_text([AgentSizes("puck", SEES, ACTS)])
    (agent,) = agents_of({f"0/{name}": array for name, array in own.items()}, roster)
    file.write_bytes(torchscript_bytes(own, agent))
    return str(file)


def batch(seed: int, means=(0.0, 10.0)):
    """A batch of T = 8 decisions in 16 worlds, in which agents see other numbers."""
    draw = torch.Generator().manual_seed(seed)
    seen = [mean + torch.randn(8, 16, SEES, generator=draw) for mean in means]
    alive, acted = [torch.ones(8, 16, dtype=torch.bool)] * 2, [torch.zeros(8, 16, ACTS)] * 2
    return SimpleNamespace(observations=seen, alive=alive, actions=acted)


def test_a_teacher_with_a_memory_is_refused_and_one_over_skills_is_not(tmp_path):
    plain = network()
    source, target = np.arange(SEES, dtype=np.int32), np.full(SEES, ACTS, np.int32)
    skill = Skill(plain, source, target, np.zeros(SEES, np.float32))
    over = teacher(tmp_path / "over.pt", {**plain, **skill_arrays([skill], 4, 1.0, False)})
    assert Distil(AGENTS, {"teachers": [over]}, 1, "cpu").learn(batch(0)).keys() == {"missed.0", "missed.1"}
    gru = teacher(tmp_path / "gru.pt", network(recurrent=3))
    with pytest.raises(ValueError, match=r"^settings.teachers: .*gru.pt has a memory \(a GRU\); give a teacher"):
        Distil(AGENTS, {"teachers": [over, gru]}, 1, "cpu")


@pytest.mark.parametrize("one", [True, False])
def test_a_student_normalises_by_all_that_its_agents_saw(one, tmp_path):
    settings = {"teachers": teacher(tmp_path / "plain.pt", network()), "one": one, "epochs": 1}
    learner, batches = Distil(AGENTS, settings, 1, "cpu"), [batch(seed) for seed in range(3)]
    for each in batches[:2]:
        learner.learn(each)
    again = Distil(AGENTS, settings, 2, "cpu")
    again.load({name: value.detach().numpy().copy() for name, value in learner.save().items()})
    again.learn(batches[2])
    for i, student in enumerate(again.students):
        whose = range(2) if one else [i]
        seen = torch.cat([each.observations[j].flatten(0, 1) for each in batches for j in whose])
        torch.testing.assert_close(student.trunk.observation_mean, seen.mean(0), atol=1e-4, rtol=1e-4)
        torch.testing.assert_close(student.trunk.observation_var, seen.var(0, unbiased=False), atol=1e-3, rtol=1e-3)
    assert (again.students[0] is again.students[1]) == one
