"""What programs remember during an episode: as an argument and result, in an object, or inside a TorchScript module."""

import numpy as np
import pytest
import torch

from agents.policy.host_policy import HostPolicy
from league.snapshots.programs import callables
from league.snapshots.programs.model import AgentSizes, Model, ModelActor, ProgramError
from league.snapshots.programs.stored import host_policies, read

ROSTER = "chooser:1:3"


def test_memory_restarts_where_an_episode_begins_in_every_seat_of_its_own():
    agent, zeros = AgentSizes("x", 1, 1), np.zeros((3, 1), np.float32)

    def count(given):
        return {"actions": given["memory"], "next_memory": given["memory"] + 1}

    class Counter:
        def __init__(self):
            self.n = 0.0

        def reset(self, first=True):
            self.n = np.where(first, 0.0, self.n)

        def __call__(self, x):
            self.n = self.n + np.ones(x.shape[:-1])
            return (self.n - 1.0)[..., None]

    makers = [
        lambda: ModelActor(Model(count, "observations", "actions", memory={"memory": 1}), agent),
        lambda: ModelActor(Model(count, "observations", "actions", memory={"memory": 1}, rows=2), agent),
        lambda: callables.BatchedCallable(Counter()),
        lambda: callables.BatchedCallable(Counter),
        lambda: callables.SingleCallable(Counter()),
    ]
    for make in makers:
        one, other = make(), make()
        steps = [[1, 1, 1], [0, 0, 0], [0, 1, 0], [0, 0, 0]]
        told = [one(zeros, zeros, np.array(first, bool)).ravel().tolist() for first in steps]
        assert told == [[0, 0, 0], [1, 1, 1], [2, 0, 2], [3, 1, 3]]
        assert other(zeros, zeros, np.ones(3, bool)).ravel().tolist() == [0, 0, 0]


def test_what_a_program_remembers_of_its_worlds_outlasts_a_recording_of_other_worlds():
    """It counts the decisions since an episode began, here in two worlds, and meanwhile in one."""
    policy, none = HostPolicy(Counter, 1, lambda what: None), np.zeros((2, 1), np.float32)
    counted = [policy.act("a", 0, none, none, np.array([begins, False])).ravel().tolist() for begins in (1, 0)]
    assert counted == [[0, 0], [1, 1]]
    assert policy.act("a", 0, none[:1], none[:1], np.ones(1, bool)).tolist() == [[0]]
    assert policy.act("a", 0, none, none, np.array([True, False])).ravel().tolist() == [0, 2]


class Gated(torch.nn.Module):
    """A GRU for one robot that keeps its hidden state inside, as exporters for legged robots write it."""

    def __init__(self):
        super().__init__()
        self.rnn, self.out = torch.nn.GRUCell(1, 4), torch.nn.Linear(4, 3)
        self.register_buffer("hidden", torch.full((1, 4), 9.0))  # of the episode in which it was saved

    def forward(self, x):
        self.hidden[:] = self.rnn(x, self.hidden)
        return self.out(self.hidden)

    @torch.jit.export
    def reset(self):
        self.hidden[:] = 0.0


class Smooth(torch.nn.Module):
    """A policy that remembers its last action in an attribute."""

    def __init__(self):
        super().__init__()
        self.last = torch.zeros(1, 3)

    def forward(self, x):
        self.last = 0.5 * self.last + x
        return self.last


@pytest.mark.parametrize("made", [Gated, Smooth])
@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
def test_a_module_that_keeps_its_state_inside_has_one_for_each_world_and_episode(tmp_path, made):
    torch.manual_seed(0)
    torch.jit.script(made()).save(str(tmp_path / "kept.pt"))
    program = read("torchscript", [str(tmp_path / "kept.pt")], ROSTER)
    assert program.singles
    (policy,) = host_policies(program.to_bytes(), "kept")
    seen, noise = np.random.default_rng(0).standard_normal((6, 3, 1), np.float32), np.zeros((3, 3), np.float32)
    first = np.array([[1, 1, 1], [0, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0]], bool)
    acted = np.stack([policy.act("a", 0, x, noise, begins) for x, begins in zip(seen, first, strict=True)])
    for world in range(3):
        alone = torch.jit.load(str(tmp_path / "kept.pt"))
        with torch.no_grad():
            for x, begins, action in zip(seen[:, world], first[:, world], acted[:, world], strict=True):
                if begins and made is Gated:
                    alone.reset()
                elif begins:
                    alone.last = torch.zeros(1, 3)
                assert action == pytest.approx(alone(torch.from_numpy(x[None])).numpy()[0], abs=1e-6)


class Numbered(torch.nn.Module):
    """A policy that counts its decisions in a number, which is no tensor."""

    count: int

    def __init__(self):
        super().__init__()
        self.count = 0

    def forward(self, x):
        self.count += 1
        return x.expand(x.shape[0], 3) * float(self.count)


@pytest.mark.filterwarnings("ignore:.torch.jit:DeprecationWarning")
def test_a_state_inside_that_cannot_be_kept_apart_is_refused_in_one_line(tmp_path):
    torch.jit.script(Numbered()).save(str(tmp_path / "n.pt"))
    with pytest.raises(
        ProgramError, match=r"n\.pt keeps its state inside, in count, .*: make it an argument x .*next_x"
    ):
        read("torchscript", [str(tmp_path / "n.pt")], ROSTER)


class Counter:
    """A policy whose action is the number of decisions since the episode began."""

    def __init__(self):
        self._past = np.zeros(0, np.float32)

    def __call__(self, observations, noise, first):
        self._past = np.where(first, 0, (self._past if len(self._past) else np.zeros(len(first))) + 1)
        return self._past[:, None].astype(np.float32)
