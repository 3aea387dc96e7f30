"""Distil teachers into one network: learner.class = "docs/examples/distil.py:Distil", settings.teachers = ["x.pt"].

As in OP3 (Haarnoja et al., 2024, stage 2) without its reward: the student acts, and learns what its teacher would have
done in what it meets (DAgger; Ross et al., 2011). A teacher is a TorchScript file of `league export --torchscript`; one
over skills chooses its command anew in each decision. One with a GRU is refused: a batch does not tell what it
remembers of decisions before.
"""

import warnings

import numpy as np
import torch

from agents.policy.networks import Actor
from agents.settings import OBSERVATION_CLIP, Architecture


class Distil:
    """Lowers the squared error between mean actions of student and teacher; one teacher for each agent, or for all."""

    def __init__(self, agents, settings, seed, device):
        if unknown := settings.keys() - {"teachers", "lr", "epochs", "hidden", "one"}:
            raise ValueError(f"settings: {', '.join(sorted(unknown))} is none of teachers, lr, epochs, hidden, one")
        files = settings.get("teachers", ())
        files = (files,) if isinstance(files, str) else files
        if len(files) not in (1, len(agents)):
            raise ValueError(f"settings.teachers: {len(files)} files for {len(agents)} agents; give one, or one each")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # torch advises torch.export
            teachers = [torch.jit.load(file, map_location=device).eval() for file in files]
        for file, teacher in zip(files, teachers, strict=True):
            if getattr(teacher, "memory_size", 0) and not hasattr(teacher, "noise_size"):  # which one over skills has
                raise ValueError(
                    f"settings.teachers: {file} has a memory (a GRU); give a teacher without, or one over skills"
                )
        self.teachers = teachers * (1 if len(teachers) == len(agents) else len(agents))
        self.epochs, sizes = settings.get("epochs", 4), [(a.observation_size, a.action_size) for a in agents]
        architecture = Architecture((settings.get("hidden", 128),) * 2, "elu")
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            made = [Actor(*size, architecture, initial_std=0.2).to(device) for size in sizes]
        # With `one`, agents with equal sizes are one network, which learns from all of their teachers.
        self.owners = [sizes.index(size) if settings.get("one", False) else i for i, size in enumerate(sizes)]
        optimisers = [torch.optim.Adam(each.parameters(), settings.get("lr", 1e-3)) for each in made]
        self.counts = [0] * len(agents)  # of observations, each at the place of the network's first agent
        self.students, self.optimisers = [made[i] for i in self.owners], [optimisers[i] for i in self.owners]

    def learn(self, batch):
        """Take `epochs` steps towards what the teachers would have done; return the shares of it missed before."""
        figures = {}
        for i, (student, teacher) in enumerate(zip(self.students, self.teachers, strict=True)):
            seen = batch.observations[i][batch.alive[i]]
            wanted = _answer(teacher, seen, batch.actions[i].shape[-1])
            self._renormalise(self.owners[i], seen)
            for epoch in range(self.epochs):
                error = (student.gaussian(seen).mean - wanted).square().mean()
                figures |= {f"missed.{i}": (error / wanted.var(0).mean()).item()} if epoch == 0 else {}
                self.optimisers[i].zero_grad()
                error.backward()
                self.optimisers[i].step()
        return figures

    def _renormalise(self, i, seen):
        """Normalise by all observations so far; what the network answers stays the same."""
        trunk, count = self.students[i].trunk, self.counts[i]
        share, before, after = len(seen) / (count + len(seen)), trunk.observation_mean, seen.mean(0)
        var = (1 - share) * trunk.observation_var + share * seen.var(0, unbiased=False)
        var += share * (1 - share) * (after - before).square()
        trunk.renormalise(before + share * (after - before), var, torch.full_like(var, count > 0, dtype=bool))
        trunk.observation_clip.fill_(OBSERVATION_CLIP)
        self.counts[i] = count + len(seen)

    def save(self):
        """Return weights, Adam's moments, and the number of observations so far."""
        weights = {f"{i}/{name}": x for i, each in enumerate(self.students) for name, x in each.state_dict().items()}
        moments = [(i, each.state_dict()["state"]) for i, each in enumerate(self.optimisers)]
        weights["counts"] = torch.tensor(self.counts)
        return weights | {f"adam/{i}/{n}/{k}": x for i, of in moments for n, own in of.items() for k, x in own.items()}

    def load(self, state):
        """Continue from what `save` gave."""
        self.counts = [int(count) for count in state["counts"]]
        for i, student in enumerate(self.students):
            student.load_state_dict({name: torch.tensor(state[f"{i}/{name}"]) for name in student.state_dict()})
        for i, optimiser in enumerate(self.optimisers):
            found = {}
            for name in (name for name in state if name.startswith(f"adam/{i}/")):
                *_, number, key = name.split("/")
                found.setdefault(int(number), {})[key] = torch.tensor(np.array(state[name]))
            optimiser.load_state_dict(optimiser.state_dict() | {"state": found})

    def export(self):
        """Return the students, which act in training too."""
        return [student.state_dict() for student in self.students]


@torch.no_grad()
def _answer(teacher, seen, actions):
    """Return a teacher's mean actions (n, act) for observations (n, obs)."""
    given = [seen, seen.new_zeros(len(seen), getattr(teacher, "noise_size", actions))]
    if size := getattr(teacher, "memory_size", 0):
        return teacher(*given, seen.new_zeros(len(seen), size))[0]
    return teacher(*given)
