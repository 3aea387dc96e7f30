"""A frozen policy's network as an ONNX file, with normalisation and scaling inside.

Inputs, all float32 and for any number N of worlds: `observations` (N, obs); `noise` (N, act), zeros for the mean action
or standard normal numbers to explore as in the league; for a recurrent policy `memory` (N, units), zeros where an
episode begins. Outputs: `actions` (N, act), and `next_memory`, the memory of the next decision.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.settings import SQUASH_EDGE, VARIANCE_FLOOR
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
        agent: its description, see `league.snapshots.policy_file.agents_of`.
        metadata: entries to write into the file.

    Raises StorageError if the package onnx is missing.
    """
    try:
        import onnx
    except ImportError as error:
        need = f"an ONNX file needs onnx ({error}); install it with: pip install 'robot-league[onnx]'"
        raise StorageError(need) from error
    graph = _Graph(onnx, arrays)
    x = _features(graph, agent)
    inputs, outputs = {"observations": agent["observation"], "noise": agent["action"]}, {"actions": agent["action"]}
    if units := agent.get("recurrent", 0):
        inputs["memory"] = outputs["next_memory"] = units
        x = _gru(graph, x, units)
    _actions(graph, x, agent)
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
        self._onnx, self.arrays = package, arrays
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._known: set[str] = set()

    def node(self, kind: str, *inputs: str, to: str = "", **attributes: Any) -> str:
        """Add an operation, and return the name of its output."""
        name = to or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(self._onnx.helper.make_node(kind, inputs, [name], name=f"{name}/node", **attributes))
        return name

    def constant(self, name: str, value: Any) -> str:
        """Add a constant once, and return its name."""
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


def _features(graph: _Graph, agent: Mapping[str, Any]) -> str:
    """Normalise observations and apply the hidden layers."""
    deviation = np.sqrt(np.maximum(graph.arrays["trunk.observation_var"], np.float32(VARIANCE_FLOOR)))
    clip = np.float32(graph.arrays["trunk.observation_clip"])
    x = graph.node("Sub", "observations", graph.parameter("trunk.observation_mean"))
    x = graph.node("Div", x, graph.constant("observation_deviation", deviation))
    x = graph.node("Clip", x, graph.constant("least", -clip), graph.constant("most", clip))
    if agent.get("entities"):
        x = _encoded(graph, x, agent)
    x = graph.layer_norm(x, "trunk.norm.0")
    for i in range(len(agent["hidden"])):
        x = graph.linear(x, f"trunk.hidden.{i}.weight", f"trunk.hidden.{i}.bias")
        x = graph.node(agent["activation"].capitalize(), x)
        x = graph.layer_norm(x, f"trunk.norm.{i + 1}")
    return x


def _encoded(graph: _Graph, x: str, agent: Mapping[str, Any]) -> str:
    """Return own numbers, and mean and maximum of each set of entities; see `agents.policy.entities`."""
    found = [graph.node("Gather", x, graph.constant("own", graph.arrays["trunk.own"].tolist()), axis=1)]
    zero, one, far = (graph.constant(name, value) for name, value in (("zero", 0.0), ("one", 1.0), ("far", FAR)))
    over = graph.constant("over_entities", [1])
    for i, shape in enumerate(agent["entities"]):
        name = f"trunk.entities.{i}"
        places = graph.constant(f"places_{i}", graph.arrays[f"{name}.index"].reshape(-1).tolist())
        rows_of = graph.constant(f"rows_{i}", [-1, *shape[:2]])
        raw, rows = (
            graph.node("Reshape", graph.node("Gather", each, places, axis=1), rows_of) for each in ("observations", x)
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


def _actions(graph: _Graph, x: str, agent: Mapping[str, Any]) -> None:
    """Compute `actions` from the last layer's input and the noise."""
    plain = "std_logit" in graph.arrays
    logit = graph.parameter("std_logit") if plain else graph.linear(x, "deviation.weight", "deviation.bias")
    mean = graph.linear(x, "mean.weight", "mean.bias")
    deviation = graph.node("Mul", graph.node("Sigmoid", logit), graph.parameter("std_scale"))
    spread = graph.node("Mul", deviation, "noise")
    if agent["squash"] is None:
        graph.node("Add", mean, spread, to="actions")
        return
    limit = graph.parameter("squash")
    share = graph.node("Tanh", graph.node("Div", graph.node("Add", mean, spread), limit))
    edges = graph.constant("inner_edge", -SQUASH_EDGE), graph.constant("outer_edge", SQUASH_EDGE)
    graph.node("Mul", limit, graph.node("Clip", share, *edges), to="actions")
