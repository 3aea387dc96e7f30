"""A frozen policy's network as an ONNX file, with normalisation and scaling inside.

Inputs, all float32 and for any number N of worlds: `observations` (N, obs); `noise` (N, act), zeros for the mean action
or standard normal numbers to explore as in the league; for a policy that remembers `memory` (N, units), zeros where an
episode begins. A policy over skills remembers its command, and takes noise for commands. Outputs: `actions` (N, act),
and `next_memory`, the memory of the next decision.
"""

from collections.abc import Mapping
from copy import copy
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.policy.skill_arrays import PREFIX, skill_of
from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR
from league.snapshots.exports.networks import memory_units, noise_size
from storage.errors import StorageError

if TYPE_CHECKING:
    import onnx

OPSET, IR_VERSION = 17, 8  # ONNX 1.12, of June 2022: the first with LayerNormalization
EPSILON = 1e-5  # of LayerNorm in torch
FAR = 1e30  # below all features of entities


def onnx_bytes(arrays: Mapping[str, np.ndarray], agent: Mapping[str, Any], metadata: Mapping[str, str]) -> bytes:
    """Return the ONNX file of one agent's network.

    Args:
        arrays: its parameters, by the names of `agents.policy.networks.Actor`.
        agent: its description, see `league.snapshots.exports.networks.agents_of`.
        metadata: entries to write into the file.

    Raises StorageError if the package onnx is missing.
    """
    try:
        import onnx
    except ImportError as error:
        need = f"an ONNX file needs onnx ({error}); install it with: pip install 'robot-league[onnx]'"
        raise StorageError(need) from error
    graph = _Graph(onnx, arrays)
    inputs, outputs = {"observations": agent["observation"], "noise": noise_size(agent)}, {"actions": agent["action"]}
    if units := memory_units(agent):
        inputs["memory"] = outputs["next_memory"] = units
    if "over" in agent:
        _over_skills(graph, agent["over"])
    else:
        x = _features(graph, agent)
        _actions(graph, _gru(graph, x, units) if units else x, agent)
    kind = onnx.TensorProto.FLOAT
    ends = [
        [onnx.helper.make_tensor_value_info(name, kind, ["N", size]) for name, size in each.items()]
        for each in (inputs, outputs)
    ]
    made = onnx.helper.make_graph(graph.nodes, "policy", *ends, initializer=graph.constants)
    model = onnx.helper.make_model(
        made, opset_imports=[onnx.helper.make_opsetid("", OPSET)], producer_name="robot-league", ir_version=IR_VERSION
    )
    onnx.helper.set_model_props(model, dict(metadata))
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString(deterministic=True)


class _Graph:
    """Nodes and constants of a graph under construction. A value is known by its name."""

    def __init__(self, package: Any, arrays: Mapping[str, np.ndarray]):
        self._onnx, self.arrays, self._prefix = package, arrays, ""
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._known: set[str] = set()

    def inside(self, prefix: str, arrays: Mapping[str, np.ndarray]) -> "_Graph":
        """Return this graph for another network of it, whose constants have names with a prefix."""
        found = copy(self)
        found.arrays, found._prefix = arrays, prefix
        return found

    def node(self, kind: str, *inputs: str, to: str = "", **attributes: Any) -> str:
        """Add an operation, and return the name of its output."""
        name = to or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(kind, inputs, [name], name=f"{name}/node", **attributes))
        return name

    def constant(self, name: str, value: Any) -> str:
        """Add a constant once, and return its name."""
        name = self._prefix + name
        if name not in self._known:
            self._known.add(name)
            dtype = np.int64 if isinstance(value, list) else np.float32
            self.constants.append(self._onnx.numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def parameter(self, name: str) -> str:
        """Return a parameter of the network as a constant."""
        return self.constant(name, self.arrays[name])

    def linear(self, x: str, weight: str, bias: str, to: str = "") -> str:
        """Apply a linear layer, stored as in torch."""
        return self.node("Gemm", x, self.parameter(weight), self.parameter(bias), to=to, transB=1)

    def layer_norm(self, x: str, name: str) -> str:
        """Apply a LayerNorm if the network has it."""
        if f"{name}.weight" not in self.arrays:
            return x
        scale, bias = self.parameter(f"{name}.weight"), self.parameter(f"{name}.bias")
        return self.node("LayerNormalization", x, scale, bias, axis=-1, epsilon=EPSILON)

    def as_number(self, x: str) -> str:
        """Return truth as 1.0 and 0.0."""
        name = f"cast_{len(self.nodes)}"
        kind = self._onnx.TensorProto.FLOAT
        self.nodes.append(self._onnx.helper.make_node("Cast", [x], [name], name=f"{name}/node", to=kind))
        return name

    def part(self, x: str, first: int, end: int) -> str:
        """Return some columns of a value."""
        axis = self.constant("axis", [1])
        return self.node("Slice", x, self.constant(f"at_{first}", [first]), self.constant(f"at_{end}", [end]), axis)


def _features(graph: _Graph, agent: Mapping[str, Any], observed: str = "observations") -> str:
    """Normalise observations and apply the hidden layers."""
    deviation = np.sqrt(np.maximum(graph.arrays["trunk.observation_var"], np.float32(VARIANCE_FLOOR)))
    clip = np.float32(graph.arrays["trunk.observation_clip"])
    x = graph.node("Sub", observed, graph.parameter("trunk.observation_mean"))
    x = graph.node("Div", x, graph.constant("observation_deviation", deviation))
    x = graph.node("Clip", x, graph.constant("least", -clip), graph.constant("most", clip))
    if agent.get("entities"):
        x = _encoded(graph, x, agent, observed)
    x = graph.layer_norm(x, "trunk.norm.0")
    for i in range(len(agent["hidden"])):
        x = graph.linear(x, f"trunk.hidden.{i}.weight", f"trunk.hidden.{i}.bias")
        x = graph.node(agent["activation"].capitalize(), x)
        x = graph.layer_norm(x, f"trunk.norm.{i + 1}")
    return x


def _encoded(graph: _Graph, x: str, agent: Mapping[str, Any], observed: str) -> str:
    """Return own numbers, and mean and maximum of each set of entities; see `agents.policy.entities`."""
    found = [graph.node("Gather", x, graph.constant("own", graph.arrays["trunk.own"].tolist()), axis=1)]
    zero, one, far = (graph.constant(name, value) for name, value in (("zero", 0.0), ("one", 1.0), ("far", FAR)))
    over = graph.constant("over_entities", [1])
    for i, shape in enumerate(agent["entities"]):
        name = f"trunk.entities.{i}"
        places = graph.constant(f"places_{i}", graph.arrays[f"{name}.index"].reshape(-1).tolist())
        rows_of = graph.constant(f"rows_{i}", [-1, *shape[:2]])
        raw, rows = (
            graph.node("Reshape", graph.node("Gather", each, places, axis=1), rows_of) for each in (observed, x)
        )
        nothing = graph.node("Equal", graph.node("ReduceMax", graph.node("Abs", raw), axes=[2], keepdims=1), zero)
        absent = graph.as_number(nothing)
        there = graph.node("Sub", one, absent)
        for layer in range(2):
            weight = graph.constant(f"{name}.layers.{layer}.turned", graph.arrays[f"{name}.layers.{layer}.weight"].T)
            rows = graph.node("Add", graph.node("MatMul", rows, weight), graph.parameter(f"{name}.layers.{layer}.bias"))
            rows = graph.node(agent["activation"].capitalize(), rows)
        known = graph.node("Mul", rows, there)
        count = graph.node("Max", graph.node("ReduceSum", there, over, keepdims=0), one)
        found.append(graph.node("Div", graph.node("ReduceSum", known, over, keepdims=0), count))
        most = graph.node("ReduceMax", graph.node("Sub", known, graph.node("Mul", absent, far)), axes=[1], keepdims=0)
        found.append(graph.node("Mul", most, graph.node("ReduceMax", there, axes=[1], keepdims=0)))
    return graph.node("Concat", *found, axis=1)


def _gru(graph: _Graph, x: str, units: int) -> str:
    """Compute `next_memory`, and return the last layer's input; see `agents.policy.networks.GRU`."""
    news = graph.linear(x, "gru.weight_ih", "gru.bias_ih")
    own = graph.linear("memory", "gru.weight_hh", "gru.bias_hh")
    gates = graph.node("Sigmoid", graph.node("Add", graph.part(news, 0, 2 * units), graph.part(own, 0, 2 * units)))
    r, z = graph.part(gates, 0, units), graph.part(gates, units, 2 * units)
    own_n = graph.node("Mul", r, graph.part(own, 2 * units, 3 * units))
    n = graph.node("Tanh", graph.node("Add", graph.part(news, 2 * units, 3 * units), own_n))
    kept = graph.node("Mul", z, graph.node("Sub", "memory", n))
    return graph.layer_norm(graph.node("Add", n, kept, to="next_memory"), "gru.norm")


def _actions(graph: _Graph, x: str, agent: Mapping[str, Any], noise: str | None = "noise", to: str = "actions") -> str:
    """Compute actions from the last layer's input and the noise; without noise the mean ones."""
    drawn = graph.linear(x, "mean.weight", "mean.bias")
    if noise is not None:
        plain = "std_logit" in graph.arrays
        logit = graph.parameter("std_logit") if plain else graph.linear(x, "deviation.weight", "deviation.bias")
        deviation = graph.node("Mul", graph.node("Sigmoid", logit), graph.parameter("std_scale"))
        spread = graph.node("Mul", deviation, noise)
        drawn = graph.node("Add", drawn, spread, to="" if agent["squash"] is not None else to)
    if agent["squash"] is None:
        return drawn
    limit = graph.parameter("squash")
    share = graph.node("Tanh", graph.node("Div", drawn, limit))
    edges = graph.constant("inner_edge", -SQUASH_EDGE), graph.constant("outer_edge", SQUASH_EDGE)
    return graph.node("Mul", limit, graph.node("Clip", share, *edges), to=to)


def _over_skills(graph: _Graph, over: Mapping[str, Any]) -> None:
    """Compute `actions` and `next_memory` of a policy over skills; see `agents.policy.skills`."""
    choices, command, skills = over["choices"], over["command"], over["skills"]
    strategy, noise = over["strategy"], graph.part("noise", 0, choices)
    new = _actions(graph, _features(graph, strategy), strategy, noise, to="")
    left, held = graph.part("memory", 0, 1), graph.part("memory", 1, 1 + choices)
    one, every = graph.constant("one_decision", 1.0), graph.constant("every_decision", float(over["every"]))
    due = graph.node("Less", left, one)
    choice = graph.node("Where", due, new, held)
    graph.node(
        "Concat", graph.node("Sub", graph.node("Where", due, every, left), one), choice, to="next_memory", axis=1
    )
    if not skills:
        graph.node("Identity", choice, to="actions")
        return
    ends = graph.constant("least_command", -1.0), graph.constant("greatest_command", 1.0)
    reach = graph.constant("reach", graph.arrays[f"{PREFIX}reach"])
    commands = graph.node("Mul", graph.node("Clip", graph.part(choice, 0, command), *ends), reach)
    nothing = graph.node("Sub", left, left)
    seen, commanded = (graph.node("Concat", each, nothing, axis=1) for each in ("observations", commands))
    answers = []
    for i, agent in enumerate(skills):
        arrays = skill_of(graph.arrays, i)
        own = graph.inside(f"{PREFIX}{i}.", arrays)
        sources, targets = (own.constant(name, arrays[name].tolist()) for name in ("source", "target"))
        x = own.node("Add", own.node("Gather", seen, sources, axis=1), own.parameter("fill"))
        x = own.node("Add", x, own.node("Gather", commanded, targets, axis=1))
        answers.append(_actions(own, _features(own, agent, x), agent, None, to=""))
    if len(answers) == 1:
        graph.node("Identity", answers[0], to="actions")
        return
    scores = graph.part(choice, command, choices)
    weights = graph.node("Softmax" if over["blend"] else "Hardmax", scores, axis=1)
    shares = [graph.node("Mul", graph.part(weights, i, i + 1), each) for i, each in enumerate(answers)]
    graph.node("Sum", *shares, to="actions")
