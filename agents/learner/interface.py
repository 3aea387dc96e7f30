"""The interface of a learner to a league: a class with five methods. `HappoLearner` is such a class.

A league makes one learner for each player, and calls it in this order: `act` before each rollout, `learn` after it, and
`save` and `export` where a turn ends. `load` continues from what `save` gave, in the same process or another one.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from agents.policy.host_policy import Actor

if TYPE_CHECKING:
    from agents.batch import Batch

State = Mapping[str, Any]
"""Arrays by name, of numpy or torch."""
Policy = State | bytes | Any
"""The state dict of an Actor, the content of an ONNX or TorchScript file, or a TorchScript module."""


class Learner(Protocol):
    """A team that learns.

    A class of yours is made as `Mine(agents, settings, seed, device)`: the team's agents (`arenas.state.AgentSpec`:
    name, kind, observation_size, action_size), the table `learner.settings`, a number that seeds all that is random,
    and the torch device on which batches lie. It may raise ValueError for settings that it refuses. Everything random
    in it has to follow from the seed and to be part of `save`, or a league that was killed ends otherwise than one that
    was not.

    Two more methods are called where a class has them: `reseed(seed)` gives it other random numbers after a setback,
    and `meet(opponents)` tells it before the rollouts of a turn against whom they are, by a text for each of the equal
    groups of worlds. Equal texts are equal policies, but for opponents that learn at the same time.
    """

    def act(self) -> Sequence[Policy | Actor]:
        """Return how each agent acts in the next rollout: a state dict, or a function that is called on the host.

        A state dict is that of an `agents.policy.networks.Actor`, and is compiled into the rollout. A function gets
        observations (n, obs), standard normal noise (n, act) and where episodes begin, (n,) bool, and returns actions
        (n, act), all of numpy. Without this verb agents act by what `export` gives.
        """
        return self.export()

    def learn(self, batch: "Batch") -> Mapping[str, float]:
        """Learn from the team's rollout, and return figures of the learning curve, all finite.

        Nothing in the batch is NaN: decisions that are void, and agents that were out of the game, have zeros.
        """
        ...

    def save(self) -> State:
        """Return everything that `load` needs to continue, as arrays by name."""
        ...

    def load(self, state: State) -> None:
        """Continue from what `save` gave, there as arrays of numpy."""
        ...

    def export(self) -> Sequence[Policy]:
        """Return the policy of each agent that a snapshot keeps, in the form in which it plays matches.

        docs/policies.md says what the inputs and outputs of programs are. Equal policies have to give equal bytes, or a
        deterministic league is none.
        """
        ...
