"""What can be set about learning. Loads nothing heavy: configurations are read where torch is not."""

from dataclasses import dataclass, field
from typing import Literal

Activation = Literal["tanh", "relu", "elu"]
ACTIVATIONS: tuple[Activation, ...] = ("tanh", "relu", "elu")

# Normalised observations, in torch as in JAX: a feature that was constant so far must not explode when it moves.
VARIANCE_FLOOR = 1e-4
OBSERVATION_CLIP = 10.0

# A squashed action is held this share of its limit away from it: there its density is still finite, in torch as in JAX.
SQUASH_EDGE = 1 - 1e-6

Method = Literal["happo", "mappo", "ippo", "hatrpo"]
Precision = Literal["float32", "tf32", "bf16"]
CriticInput = Literal["own", "all", "privileged", "same"]


@dataclass(frozen=True)
class Architecture:
    """The shape of a network, shared by a league's actors and critics."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Activation = "tanh"
    """Non-linearity after each hidden layer."""
    layer_norm: bool = False
    """LayerNorm on the input and after each hidden layer, as HARL has it."""
    squash: float | None = field(default=None, metadata={"above": 0.0, "high": 1000.0})
    """Actions are this limit times tanh(Gaussian / limit), and so within ± it (none: the Gaussian's number itself)."""
    state_std: bool = False
    """The actions' deviation is an output of the network, instead of the same whatever is seen."""
    recurrent: int = field(default=0, metadata={"low": 0, "high": 8192})
    """Units of a GRU between the hidden layers and the last one, which remembers the episode so far (0: no GRU)."""

    def __post_init__(self) -> None:
        """Refuse widths below 1."""
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: {list(self.hidden)} must be at least one width, each 1 or more")


@dataclass(frozen=True)
class TrustRegion:
    """How far and in which direction HATRPO steps, once per agent and batch; the defaults are HARL's."""

    kl: float = field(default=0.01, metadata={"above": 0.0, "high": 1.0})
    """The policy moves by at most this mean KL divergence."""
    tries: int = field(default=10, metadata={"low": 1, "high": 100})
    """Steps tried, each shorter than the one before, until one is good."""
    backtrack: float = field(default=0.8, metadata={"above": 0.0, "below": 1.0})
    """How much shorter."""
    accept: float = field(default=0.5, metadata={"low": 0.0, "below": 1.0})
    """Share of the gain promised by the gradient that a step must bring."""
    conjugate_steps: int = field(default=10, metadata={"low": 1, "high": 1000})
    """Iterations of the conjugate gradient that solves for the direction."""
    damping: float = field(default=0.1, metadata={"low": 0.0})
    """Added to the diagonal of the KL divergence's Hessian."""


@dataclass(frozen=True)
class HappoConfig:
    """The learner's settings; HARL-A's own values are in docs/learning.md."""

    architecture: Architecture = field(default_factory=Architecture)
    """Networks of actors and critics."""
    method: Method = "happo"
    """happo: agents one after the other, each on the advantage times M; mappo: all on the same advantage, without M;
    ippo: each on its own critic's advantage, which sees what the agent sees; hatrpo: as happo, by trust region."""
    trust_region: TrustRegion = field(default_factory=TrustRegion)
    """HATRPO's steps; other methods have none."""
    critic_input: CriticInput = "own"
    """What the critic sees. own: its own team's observations; all: those of all teams; privileged: its own team's and
    the arena's whole state; same: those of all teams and for which of them it judges, whose games it all learns
    from."""
    share_actors: bool = False
    """Equal robots of a team act by one actor, and learn it together."""
    lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Adam's step size for the actors."""
    critic_lr: float = field(default=1e-3, metadata={"low": 0.0, "high": 1.0})
    """Adam's step size for the critic."""
    gamma: float = field(default=0.985, metadata={"low": 0.0, "high": 1.0})
    """Discount per decision."""
    lam: float = field(default=0.95, metadata={"low": 0.0, "high": 1.0})
    """λ of the advantage estimate."""
    clip: float = field(default=0.2, metadata={"low": 0.0, "high": 1.0})
    """PPO's ε, for ratios and for values."""
    entropy: float = field(default=0.005, metadata={"low": 0.0})
    """Weight of the entropy bonus (HATRPO has none)."""
    kl_stop: float | None = field(default=None, metadata={"above": 0.0})
    """An actor's passes over a batch end when its mean KL divergence in one of them exceeds this (none: never)."""
    kl_step: float | None = field(default=None, metadata={"above": 0.0})
    """An actor's step size is divided by 1.5 after a minibatch with twice this KL divergence, and multiplied by 1.5
    after one with half of it, between 1e-5 and 1e-2 (none: `lr` stays)."""
    decay_steps: int = field(default=0, metadata={"low": 0})
    """Environment steps learnt from over which all step sizes fall linearly to nothing (0: they stay)."""
    epochs: int = field(default=4, metadata={"low": 1})
    """Passes over each batch, for actors and critic; HATRPO's actors take one step on the whole of it."""
    minibatches: int = field(default=4, metadata={"low": 1})
    """Parts into which each pass splits the batch."""
    chunk: int = field(default=10, metadata={"low": 1, "high": 100_000})
    """Consecutive decisions through which a recurrent network is taught at once; must divide training.rollout."""
    max_grad_norm: float = field(default=0.5, metadata={"low": 0.0})
    """Gradients are scaled down to this norm."""
    huber_delta: float = field(default=10.0, metadata={"low": 0.0})
    """Where the value loss turns from square to linear, in normalised units."""
    initial_std: float = field(default=0.8, metadata={"low": 0.01, "high": 10.0})
    """Standard deviation of a fresh policy's actions (HARL-A: 0.366)."""
    value_norm: bool = True
    """Normalise returns by their running mean and deviation (ValueNorm)."""
    normalise_observations: bool = False
    """Normalise observations by their running mean and deviation; the statistics are part of the policy."""
    fixed_order: bool = False
    """Update the agents in the team's order instead of a fresh random one each time (HARL-A: true)."""
    graphs: bool = True
    """On a GPU, replay the update as CUDA graphs instead of launching every kernel by itself; with several
    `training.devices` where messages between them can be recorded, which is tried."""
    compiled: bool = False
    """Compile advantages, losses, their gradients and Adam's steps by torch.compile: fewer kernels, the same numbers to
    rounding, and some seconds more at the start. It needs a C++ compiler, and Triton on a GPU."""
    precision: Precision = "float32"
    """Of matrix products while learning: float32; tf32 (10 bits instead of 23; on a CPU the same as float32); bf16 (7
    bits, where losses are computed). Weights, moments, densities, advantages and sums are float32 always."""

    def __post_init__(self) -> None:
        """Refuse what contradicts itself."""
        if self.method == "ippo" and self.critic_input != "own":
            raise ValueError("critic_input: ippo's critics see what their own agents see; use own, or another method")
        if self.architecture.recurrent and self.critic_input == "same":
            raise ValueError("critic_input: one critic for all teams remembers nothing; use own, all or privileged")
        if self.method == "hatrpo":
            for name in ("kl_stop", "kl_step"):
                if getattr(self, name) is not None:
                    raise ValueError(f"{name}: hatrpo bounds its steps itself; use trust_region.kl, and none here")
        if self.kl_step is not None and self.decay_steps:
            raise ValueError("kl_step: the step size can follow the KL divergence or decay_steps, not both")

    @property
    def sequence(self) -> int | None:
        """Decisions in a row of what networks learn from: a chunk; None where each decision is a row of its own."""
        return self.chunk if self.architecture.recurrent else None
