"""Cooperation in MAMuJoCo (Peng et al., 2021): returns of the learners sac and happo over environment steps.

    pip install --no-deps gymnasium-robotics pettingzoo
    python -m experiments.mamujoco HalfCheetah 2x3 --learner sac --steps 1000000 --processes 16 --out halfcheetah.json

The robot's joints are divided among agents, each of which observes its own and its neighbours' parts; the critic also
observes the whole state. The learners are those of a league, given batches of these worlds instead of an arena's. After
every `--every` steps a line is printed and a point written: the mean return of the episodes that ended since, with
exploration.
"""

import json
import multiprocessing
import time
import tomllib
from dataclasses import replace
from multiprocessing.connection import Connection

import numpy as np
import torch

from agents.batch import Batch, CriticView
from agents.learner.happo import HappoLearner
from agents.off_policy.sac import SacLearner
from agents.policy.networks import Actor
from agents.settings import Architecture, HappoConfig, ReplaySettings, SacSettings
from arenas.state import AgentSpec
from league.config.build import build
from scripts.record import make_parser, run_info, write

Learner = SacLearner | HappoLearner


def main() -> None:
    """Learn, and print and write the returns."""
    parser = make_parser(__doc__)
    parser.add_argument("robot", help="HalfCheetah, Walker2d, Ant, ...")
    parser.add_argument("division", help="of its joints: 2x3, 6x1, ...")
    parser.add_argument("--learner", choices=("sac", "happo"), default="sac")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of all worlds together")
    parser.add_argument("--every", type=int, default=20_000, help="steps between two points")
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--processes", type=int, default=1, help="that step the worlds")
    parser.add_argument("--rollout", type=int, help="decisions between two updates; 8 of sac, 200 of happo")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1, help="of torch")
    parser.add_argument("--device", default="cpu")
    parser.add_argument(
        "--set", nargs="*", default=[], metavar="NAME=VALUE", help="settings of learner.sac, as in TOML"
    )
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    worlds = Worlds(args.robot, args.division, args.worlds, args.processes, args.seed)
    learner = make_learner(args.learner, worlds, args.seed, torch.device(args.device), args.set)
    length = args.rollout or {"sac": 8, "happo": 200}[args.learner]
    result, began = {**run_info(args.commit), "learner": repr(learner.config), "points": []}, time.monotonic()
    steps, due, returns, told = 0, args.every, [], {}
    while steps < args.steps:
        batch, ended = worlds.rollout(learner, length)
        told = learner.learn(batch) or told
        steps, returns = steps + length * args.worlds, returns + ended
        if steps >= due:
            due += args.every
            point = {"steps": steps, "seconds": round(time.monotonic() - began, 1), "episodes": len(returns)}
            point |= {"return": round(float(np.mean(returns)), 1) if returns else None}
            print(json.dumps(point | {k: round(v, 4) for k, v in told.items()}), flush=True)
            result["points"].append(point)
            write(result, args.out)
            returns = []


def make_learner(name: str, worlds: "Worlds", seed: int, device: torch.device, own: list[str]) -> Learner:
    """Return a learner with settings for few worlds; those of HAPPO are MAMuJoCo's of HARL, but for shorter batches."""
    agents, size = worlds.agents, sum(a.observation_size for a in worlds.agents) + worlds.state_size
    base = HappoConfig(gamma=0.99, critic_input="privileged", normalise_observations=True)
    if name == "happo":
        config = replace(
            base, architecture=Architecture((128, 128, 128), "relu", layer_norm=True), lr=5e-4, critic_lr=5e-4,
            epochs=5, minibatches=1, clip=0.2, entropy_coef=0.01, max_grad_norm=10.0, initial_std=0.5,
        )  # fmt: skip
        sizes = [a.observation_size for a in agents], [a.action_size for a in agents]
        return HappoLearner(*sizes, config, seed, str(device), critic_size=size)
    first = SacSettings(ReplaySettings(1_000_000, 10_000), batch=256, replay_ratio=64.0)
    sac = build(SacSettings, tomllib.loads("\n".join(own)), first)
    config = replace(base, class_="sac", sac=sac, architecture=Architecture((128, 128), "relu", squash=1.0))
    return SacLearner(agents, config, seed, device, size)


class Worlds:
    """Worlds of one robot, in processes of their own; they continue from one rollout to the next."""

    def __init__(self, robot: str, division: str, worlds: int, processes: int, seed: int):
        context, parts = multiprocessing.get_context("spawn"), np.array_split(np.arange(worlds), processes)
        self.pipes: list[Connection] = []
        for part in parts:
            here, there = context.Pipe()
            context.Process(
                target=serve, args=(there, robot, division, (part + 1000 * seed).tolist()), daemon=True
            ).start()
            self.pipes.append(here)
        sizes, acts, self.state_size, _ = self.pipes[0].recv()
        for pipe in self.pipes[1:]:
            pipe.recv()
        self.agents = [
            AgentSpec(f"agent/{i}", f"part{i}", *each) for i, each in enumerate(zip(sizes, acts, strict=True))
        ]
        self.rng = torch.Generator().manual_seed(seed)
        self._seen = self._gathered()  # observations of each agent, and the state
        self._returns = np.zeros(worlds)

    def rollout(self, learner: Learner, length: int) -> tuple[Batch, list[float]]:
        """Let all agents act by their policies for so many decisions; also return the returns of ended episodes."""
        actors = learner.actors if isinstance(learner, HappoLearner) else [a.network for a in learner.agents]
        rows, ended = [], []
        for _ in range(length):
            drawn = [self._draw(actor, seen) for actor, seen in zip(actors, self._seen[:-1], strict=True)]
            joint = np.concatenate([action.numpy() for action, _ in drawn], -1)
            for pipe, part in zip(self.pipes, np.array_split(joint, len(self.pipes)), strict=True):
                pipe.send(part)
            after, rewards, terminated, truncated = self._gathered(), *self._flags()
            rows.append((self._seen, after, drawn, rewards, terminated, truncated))
            self._returns += rewards
            over = terminated | truncated
            ended += self._returns[over].tolist()
            self._returns[over] = 0.0
            self._seen = self._gathered()  # of new episodes where one ended
        return self._batch(rows, learner.device), ended

    def _draw(self, actor: Actor, seen: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """Return a policy's actions and log densities, by the rule by which it acts in a league."""
        device = actor.std_scale.device
        with torch.no_grad():
            policy = actor(torch.from_numpy(seen).to(device))
            gaussian = actor.gaussian(torch.from_numpy(seen).to(device))
            noise = torch.randn(gaussian.mean.shape, generator=self.rng).to(device)
            action = gaussian.mean + gaussian.stddev * noise
            if hasattr(policy, "limit"):
                action = policy.limit * torch.tanh(action / policy.limit)
            return action.cpu(), policy.log_prob(action).sum(-1).cpu()

    def _gathered(self) -> list[np.ndarray]:
        parts = [pipe.recv() for pipe in self.pipes]
        return [np.concatenate(each) for each in zip(*parts, strict=True)]

    def _flags(self) -> list[np.ndarray]:
        return self._gathered()

    def _batch(self, rows: list, device: torch.device) -> Batch:
        seen, after, drawn, rewards, terminated, truncated = zip(*rows, strict=True)
        n = len(self.agents)

        def tensor(values: list[np.ndarray]) -> torch.Tensor:
            return torch.from_numpy(np.stack(values)).to(device)

        now, then = ([tensor([each[i] for each in moments]) for i in range(n + 1)] for moments in (seen, after))
        actions, log_probs = (
            [torch.stack([each[i][k] for each in drawn]).to(device) for i in range(n)] for k in (0, 1)
        )
        ends, cuts, reward = tensor(list(terminated)), tensor(list(truncated)), tensor(list(rewards)).float()
        alive, void = [torch.ones_like(ends)] * n, torch.zeros_like(ends)
        view = CriticView(torch.cat(now, -1), torch.cat(then, -1), reward, ends, void)
        return Batch(now[:n], then[:n], actions, log_probs, alive, alive, reward, ends, cuts, void, critic_views=[view])


def serve(pipe: Connection, robot: str, division: str, seeds: list[int]) -> None:
    """Step some worlds: after each of the actions that come, send what followed, rewards and ends, and what is next."""
    from gymnasium_robotics import mamujoco_v1

    made = [mamujoco_v1.parallel_env(robot, division) for _ in seeds]
    names = made[0].possible_agents
    sizes = [[int(np.prod(made[0].observation_space(a).shape)) for a in names]]
    sizes += [[int(np.prod(made[0].action_space(a).shape)) for a in names]]
    for env, seed in zip(made, seeds, strict=True):
        env.reset(seed=seed)
    pipe.send((*sizes, len(made[0].state()), len(seeds)))
    ends = np.cumsum(sizes[1])[:-1]

    def look(worlds: list[dict]) -> list[np.ndarray]:
        own = [np.stack([world[a] for world in worlds]).astype(np.float32) for a in names]
        return [*own, np.stack([env.state() for env in made]).astype(np.float32)]

    seen = [env.reset(seed=seed)[0] for env, seed in zip(made, seeds, strict=True)]
    pipe.send(look(seen))
    while True:
        try:
            joint, flags = pipe.recv().clip(-1.0, 1.0), []
        except EOFError:
            return
        for i, env in enumerate(made):
            acts = dict(zip(names, np.split(joint[i], ends), strict=True))
            seen[i], rewards, terminated, truncated, _ = env.step(acts)
            flags.append((rewards[names[0]], terminated[names[0]], truncated[names[0]]))
        pipe.send(look(seen))
        rewards, terminated, truncated = (np.array(each) for each in zip(*flags, strict=True))
        pipe.send((rewards, terminated, truncated))
        for i, over in enumerate(terminated | truncated):
            if over:
                seen[i] = made[i].reset()[0]
        pipe.send(look(seen))


if __name__ == "__main__":
    main()
