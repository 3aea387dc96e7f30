"""Settings of the learner. Imports nothing heavy, because configurations are also read where torch is not installed."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from arenas.arena_settings import Table

Activation = Literal["tanh", "relu", "elu"]
ACTIVATIONS: tuple[Activation, ...] = ("tanh", "relu", "elu")

# In torch and in JAX: a feature that was constant so far must not explode when it changes.
VARIANCE_FLOOR = 1e-4
OBSERVATION_CLIP = 10.0

# Squashed actions stay within this share of their limit, where the density is finite in torch and in JAX.
SQUASH_EDGE = 1 - 1e-6

Method = Literal["happo", "mappo", "ippo", "hatrpo"]
Precision = Literal["float32", "tf32", "bf16"]
CriticInput = Literal["own", "all", "privileged", "same"]
HAPPO = "happo"
"""The learner that comes with the league, among the values of `learner.class`."""
REMOVED = {
    "sac": f"the learner sac was removed, because {HAPPO} was faster wherever it was measured; use {HAPPO}, or commit"
    " 7228567, the last one that has it"
}
"""Learners that an earlier version had, with a line for a person who asks for one. Leagues of theirs open as they are,
and learn no more."""
MAX_LAYERS = 32
"""Maximum number of hidden layers. Deeper networks without residual connections do not learn."""


def check_class(value: str | None) -> None:
    """Raise ValueError unless a text names a learner: happo, file.py:Class, or one that was removed."""
    if value not in (None, HAPPO, *REMOVED) and not re.search(r"\.py:\w+$", value):
        raise ValueError(f"must be {HAPPO}, or a class in a file of yours: my/learner.py:Mine")


COMMAND = re.compile(r"([^:=]+)(?::([1-9]\d{0,3}))?(?:=([^:=]+))?")
"""PART, PART:COUNT, PART=HERE or PART:COUNT=HERE: see `SkillSettings.command`."""


def check_commands(values: tuple[str, ...]) -> None:
    """Raise ValueError unless each text is a command: see `COMMAND`."""
    for value in values:
        if not COMMAND.fullmatch(value):
            raise ValueError(
                f"{value!r} is no part: give its name, if need be with a number of numbers and the part that is seen in"
                ' its place, "slot A:2" or "goal:2=ball"'
            )


@dataclass(frozen=True)
class Architecture:
    """Architecture of a network, the same for all actors and critics of a league."""

    hidden: tuple[int, ...] = field(default=(64, 64), metadata={"high": 8192, "most": MAX_LAYERS})
    """Widths of the hidden layers."""
    activation: Activation = "tanh"
    """Non-linearity after each hidden layer."""
    layer_norm: bool = False
    """Apply LayerNorm to the input and after each hidden layer, as in HARL."""
    squash: float | None = field(default=None, metadata={"above": 0.0, "high": 1000.0})
    """Limit c of actions, which are then c times tanh(Gaussian / c), within ±c (none: the Gaussian sample itself)."""
    state_std: bool = False
    """Let the network output the standard deviation of actions instead of using one value for all observations."""
    entities: int = field(default=0, metadata={"low": 0, "high": 8192})
    """Width of the encoder of each set of entities that an arena's observations declare: one encoder for all entities
    of a set, whose masked mean and maximum replace them, so that their order has no effect (0: they are numbers like
    all others)."""
    recurrent: int = field(default=0, metadata={"low": 0, "high": 8192})
    """Units of a GRU between the hidden layers and the last layer; its hidden state covers the episode so far (0: no
    GRU)."""

    def __post_init__(self) -> None:
        """Raise ValueError for widths below 1."""
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: {list(self.hidden)} must be at least one width, each 1 or more")


@dataclass(frozen=True)
class TrustRegion:
    """Constants of HATRPO's step, taken once per agent and batch; the defaults are HARL's."""

    kl_threshold: float = field(default=0.01, metadata={"above": 0.0, "high": 1.0, "formerly": "kl"})
    """Maximum mean KL divergence of the policy in one step."""
    line_search_steps: int = field(default=10, metadata={"low": 1, "high": 100, "formerly": "tries"})
    """Maximum number of step lengths tried by the backtracking line search."""
    backtrack_coeff: float = field(default=0.8, metadata={"above": 0.0, "below": 1.0, "formerly": "backtrack"})
    """Factor by which the line search shortens the step each time."""
    accept_ratio: float = field(default=0.5, metadata={"low": 0.0, "below": 1.0, "formerly": "accept"})
    """Minimum improvement of an accepted step, as a share of the improvement that the gradient predicts."""
    conjugate_steps: int = field(default=10, metadata={"low": 1, "high": 1000})
    """Iterations of the conjugate gradient method that solves for the step's direction."""
    damping: float = field(default=0.1, metadata={"low": 0.0})
    """Value added to the diagonal of the KL divergence's Hessian."""


@dataclass(frozen=True)
class SkillSettings:
    """Skill below, strategy above: frozen policies that act, and are commanded by what learns (docs/skills.md)."""

    policies: tuple[str, ...] = field(default=(), metadata={"most": 8})
    """Frozen policies: names of those that come with the league, or files that `league export` wrote. Each agent acts
    through those of its kind of robot; without any the learner's own actions are the robot's."""
    command: tuple[str, ...] = field(default=(), metadata={"most": 8, "valid": check_commands})
    """Parts of the skills' observations that are commanded, one for each policy or one for all: a part's name, as
    `league arenas` lists them, after a colon how many of its first numbers ("slot A:2"), and after = the part of the
    agent's own observation that the skill sees in its place, where that has another name ("goal:2=ball")."""
    mode: Literal["shift", "replace"] = "shift"
    """shift: a command is added to what the agent itself observes there, so that a command of zero is the skill as it
    is; replace: the skill observes the command instead."""
    reach: float = field(default=2.0, metadata={"above": 0.0, "high": 1000.0})
    """Largest number of a command, in the part's unit: an action of ±1 of the strategy commands ± this."""
    every: int = field(default=8, metadata={"low": 1, "high": 1000})
    """Decisions of the arena for which a command is held; must divide training.rollout_length."""
    combine: Literal["choose", "blend"] = "choose"
    """Several skills of one agent: the strategy has a further action for each of them, a score. choose: the skill with
    the highest score acts; blend: the mean of their actions, weighted by the softmax of the scores."""

    def __post_init__(self) -> None:
        """Raise ValueError for skills without commands, and for commands without skills."""
        if self.policies and len(self.command) not in (1, len(self.policies)):
            raise ValueError(
                f"command: {len(self.command)} parts for {len(self.policies)} policies; give one for each, or one for"
                " all of them"
            )
        if self.command and not self.policies:
            raise ValueError("command: there is no skill to command; name them in policies")

    @property
    def clock(self) -> int:
        """Decisions of the arena per decision of what learns; 1 without skills."""
        return self.every if self.policies else 1


@dataclass(frozen=True)
class HappoConfig:
    """Settings of the learner; the preset `harl_a` has HARL-A's values."""

    REMOVED: ClassVar[Mapping[str, str]] = REMOVED  # each had a section of its own, which happo never read

    architecture: Architecture = field(default_factory=Architecture)
    """Networks of actors and critics."""
    method: Method = "happo"
    """happo: agents are updated one after the other, each on the advantage times M; mappo: all on the same advantage,
    without M; ippo: each on the advantage of its own critic, which observes what the agent observes; hatrpo: happo with
    a trust region."""
    trust_region: TrustRegion = field(default_factory=TrustRegion)
    """HATRPO's steps; other methods ignore this section."""
    critic_input: CriticInput = "own"
    """Input of the critic.

    own: observations of its own team; all: of all teams; privileged: of its own team, and the arena's full state; same:
    of all teams, and the team that is judged, with one critic that learns from all teams' games.
    """
    share_actors: bool = False
    """Let equal robots of a team share one actor, which learns from all of them."""
    lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Learning rate of the actors (Adam)."""
    critic_lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Learning rate of the critic (Adam)."""
    gamma: float = field(default=0.985, metadata={"low": 0.0, "high": 1.0})
    """Discount factor per decision."""
    gae_lambda: float = field(default=0.95, metadata={"low": 0.0, "high": 1.0, "formerly": "lam"})
    """λ of generalised advantage estimation (GAE)."""
    clip: float = field(default=0.2, metadata={"low": 0.0, "high": 1.0})
    """PPO's clip range ε, for ratios and for values."""
    entropy_coef: float = field(default=0.005, metadata={"low": 0.0, "formerly": "entropy"})
    """Weight of the entropy bonus (HATRPO has none)."""
    magnet_coef: float = field(default=0.0, metadata={"low": 0.0})
    """Weight of the KL divergence of the policy from its magnet, an earlier policy of the player: magnetic mirror
    descent (0: no magnet)."""
    magnet_updates: int = field(default=0, metadata={"low": 0})
    """Updates after which the present policy becomes the magnet (0: never, it stays the policy that the player began
    with)."""
    target_kl: float | None = field(default=None, metadata={"above": 0.0, "formerly": "kl_stop"})
    """Early stopping: end an actor's passes over a batch after one in which its mean KL divergence exceeds this (none:
    never)."""
    desired_kl: float | None = field(default=None, metadata={"above": 0.0, "formerly": "kl_step"})
    """Adaptive learning rate, as in rsl_rl: divide an actor's learning rate by 1.5 after a minibatch with twice this KL
    divergence, and multiply it by 1.5 after one with half of it, within 1e-5 and 1e-2 (none: `lr` stays)."""
    lr_decay_steps: int = field(default=0, metadata={"low": 0, "formerly": "decay_steps"})
    """Environment steps over which all learning rates fall linearly to zero, counted while the player learns (0:
    constant)."""
    epochs: int = field(default=4, metadata={"low": 1})
    """Passes over each batch, for actors and critic; HATRPO's actors take one step on the whole batch."""
    minibatches: int = field(default=4, metadata={"low": 1})
    """Minibatches per pass."""
    chunk_length: int = field(default=10, metadata={"low": 1, "high": 100_000, "formerly": "chunk"})
    """Consecutive decisions through which gradients of a recurrent network flow; must divide
    training.rollout_length."""
    max_grad_norm: float = field(default=0.5, metadata={"low": 0.0})
    """Maximum norm of a gradient; larger ones are scaled down."""
    huber_delta: float = field(default=10.0, metadata={"low": 0.0})
    """Error at which the value loss turns from quadratic to linear, in normalised units."""
    initial_std: float = field(default=0.8, metadata={"low": 0.01, "high": 10.0})
    """Standard deviation of the actions of a new policy (HARL-A: 0.366)."""
    value_norm: bool = True
    """Normalise returns by their running mean and standard deviation (ValueNorm)."""
    normalise_observations: bool = False
    """Normalise observations by their running mean and standard deviation; the statistics are part of the policy."""
    fixed_order: bool = False
    """Update the agents in the team's order instead of a new random order in each update (HARL-A: true)."""
    cuda_graphs: bool = field(default=True, metadata={"formerly": "graphs"})
    """On a GPU, replay the update as CUDA graphs instead of launching each kernel.

    With several `training.devices`, only where messages between them can be captured, which is tested at the start.
    """
    compiled: bool = False
    """Compile advantages, losses, their gradients and Adam's steps by torch.compile: fewer kernels and the same numbers
    up to rounding, but up to a minute more at the first start, some seconds at later ones: on an H200 it pays after
    30 to 40 minutes, and after 4 to 6 at later starts. Needs a C++ compiler, and Triton on a GPU."""
    precision: Precision = "float32"
    """Precision of matrix products while learning: float32; tf32 (10 bits instead of 23; float32 on a CPU); bf16 (7
    bits, in losses only). Weights, Adam's moments, densities, advantages and sums are always float32."""
    skill: SkillSettings = field(default_factory=SkillSettings)
    """Frozen policies through which agents act."""
    class_: str = field(default=HAPPO, metadata={"key": "class", "valid": check_class})
    """The learner: happo, or a class of yours, file.py:Class, which reads no other key of this section but `settings`,
    `skill` and `critic_input` (docs/learners.md)."""
    settings: Table = field(default_factory=Table)
    """Settings of a class of yours, with the keys that it takes: learner.settings.NAME."""

    def __post_init__(self) -> None:
        """Raise ValueError for settings that contradict each other."""
        if self.settings and self.class_ == HAPPO:
            raise ValueError("settings: are those of a class of yours; name it as learner.class")
        if self.method == "ippo" and self.critic_input != "own":
            raise ValueError("critic_input: ippo's critics see what their own agents see; use own, or another method")
        if self.skill.policies and self.architecture.recurrent:
            raise ValueError("architecture.recurrent: a strategy over skills remembers nothing but its command; use 0")
        if self.architecture.recurrent and self.critic_input == "same":
            raise ValueError("critic_input: one critic for all teams remembers nothing; use own, all or privileged")
        if self.magnet_updates and not self.magnet_coef:
            raise ValueError("magnet_updates: does nothing without a magnet; give magnet_coef, e.g. 0.05")
        if self.magnet_coef and (self.architecture.recurrent or self.method == "hatrpo"):
            who = "a recurrent network" if self.architecture.recurrent else "hatrpo"
            raise ValueError(
                f"magnet_coef: {who} has no magnet; use 0, or another method without learner.architecture.recurrent"
            )
        if self.method == "hatrpo":
            for name in ("target_kl", "desired_kl"):
                if getattr(self, name) is not None:
                    raise ValueError(
                        f"{name}: hatrpo bounds its steps itself; use trust_region.kl_threshold, and none here"
                    )
        if self.desired_kl is not None and self.lr_decay_steps:
            raise ValueError("desired_kl: the learning rate can follow the KL divergence or lr_decay_steps, not both")

    @property
    def discount(self) -> float:
        """Discount factor per row of training data, which over skills is a command of several decisions."""
        return self.gamma**self.skill.clock

    @property
    def sequence(self) -> int | None:
        """Decisions per row of training data: a chunk's length for recurrent networks; None: one decision."""
        return self.chunk_length if self.architecture.recurrent else None
