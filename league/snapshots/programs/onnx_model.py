"""ONNX files as policies, run by onnxruntime on one thread of the CPU."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from league.snapshots.programs.model import ACTIONS, NEXT, NOISE, AgentSizes, Arrays, Model, ProgramError, roles

TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64}
FOLDER = "session.model_external_initializers_file_folder_path"
NOWHERE = "/dev/null/none"  # a policy is the bytes of its snapshot: no file of the working folder may add to it


def whole(data: bytes, path: Path) -> bytes:
    """Return the bytes of an ONNX file with the weights that it keeps in files beside it, as torch's exporter writes.

    Raises ProgramError if these cannot be read.
    """
    onnx = _onnx(str(path))
    try:
        model = onnx.load_model_from_string(data)
    except Exception:  # no protobuf: loading it tells why
        return data
    helper = onnx.external_data_helper
    others = [each for each in model.graph.initializer if helper.uses_external_data(each)]
    if not others:
        return data
    try:
        helper.load_external_data_for_model(model, str(path.parent))
    except Exception as error:  # onnx raises OSError, ValueError, ValidationError, ...
        named = next((pair.value for pair in others[0].external_data if pair.key == "location"), "another file")
        raise ProgramError(
            f"{path} keeps its weights in {named}, which cannot be read beside it ({type(error).__name__}): put it"
            " there, or export with external_data=False"
        ) from None
    return model.SerializeToString()


def parameters(data: bytes, name: str) -> int:
    """Return the number of all constants in an ONNX file: its weights, wherever they stand."""
    model = _onnx(name).load_model_from_string(data)
    return _constants(model.graph) + sum(_in_nodes(each.node) for each in model.functions)


def _constants(graph: Any) -> int:
    sparse = sum(math.prod(each.values.dims) for each in graph.sparse_initializer)
    return sum(math.prod(each.dims) for each in graph.initializer) + sparse + _in_nodes(graph.node)


def _in_nodes(nodes: Iterable[Any]) -> int:
    """Return the number of constants in the attributes of nodes, and in graphs below them."""
    total = 0
    for each in (attribute for node in nodes for attribute in node.attribute):
        tensors = [*each.tensors, *([each.t] if each.HasField("t") else [])]
        graphs = [*each.graphs, *([each.g] if each.HasField("g") else [])]
        total += sum(math.prod(tensor.dims) for tensor in tensors) + sum(map(_constants, graphs))
    return total


def _onnx(name: str) -> Any:
    try:
        import onnx
        import onnx.external_data_helper
    except ImportError as error:
        raise ProgramError(_need(name, "onnx", error)) from error
    return onnx


def _need(name: str, package: str, error: ImportError) -> str:
    return f"{name}: an ONNX file needs {package} ({error}); install it with: pip install 'robot-league[onnx]'"


def load(data: bytes, name: str, agent: AgentSizes) -> Model:
    """Return the model in an ONNX file. Raises ProgramError for a file that is none, or whose sizes do not fit."""
    try:
        import onnxruntime
    except ImportError as error:
        raise ProgramError(_need(name, "onnxruntime", error)) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # matches run beside training
    options.log_severity_level = 4
    options.add_session_config_entry(FOLDER, NOWHERE)
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions have no common class
        reason = " ".join(str(error).split())[:300]
        hint = "; save the weights in the file itself" if "external" in reason.lower() else ""
        raise ProgramError(f"{name} is no ONNX file that onnxruntime can load: {reason}{hint}") from None
    inputs = {each.name: each for each in session.get_inputs()}
    outputs = {each.name: each for each in session.get_outputs()}
    sees, noise, memory = roles(list(inputs), name)
    acts = ACTIONS if ACTIONS in outputs else next(iter(outputs))
    _check(name, "input", inputs[sees], agent.observation, f"a {agent.kind} of this team sees {agent.observation}")
    _check(name, "output", outputs[acts], agent.action, f"a {agent.kind} of this team acts with {agent.action}")
    if noise:
        _check(name, "input", inputs[NOISE], agent.action, f"its actions have {agent.action}")
    sizes = {each: _memory_size(name, each, inputs, outputs) for each in memory}
    rows = [_rows(name, each) for each in inputs.values()]
    shapes = {each: len(node.shape) for each, node in inputs.items()}
    types = {each: TYPES[node.type] for each, node in inputs.items()}

    def run(given: Arrays) -> Arrays:
        """Run the session; a model without an axis for worlds gets one world."""
        fed = {
            each: x.astype(types[each], copy=False).reshape(x.shape[2 - shapes[each] :]) for each, x in given.items()
        }
        found = {each: np.asarray(x) for each, x in zip(outputs, session.run(None, fed), strict=True)}
        return {each: x[None] if x.ndim == 1 else x for each, x in found.items()}

    return Model(run, sees, acts, noise, sizes, next((n for n in rows if n is not None), None))


def _check(name: str, role: str, node: Any, size: int, wanted: str) -> None:
    """Check type and shape of an input or output, as far as the file tells them."""
    where = f"{name}: {role} {node.name}"
    if node.type not in TYPES:
        raise ProgramError(f"{where} is a {node.type}, and must be a tensor of float or double")
    if not node.shape and role == "output":
        return  # not told; a trial shows it
    if len(node.shape) not in (1, 2):
        raise ProgramError(f"{where} has the shape {_shape(node)}, and must have (worlds, {size})")
    if isinstance(node.shape[-1], int) and node.shape[-1] != size:
        raise ProgramError(f"{where} has {node.shape[-1]} numbers, and {wanted}")


def _memory_size(name: str, memory: str, inputs: dict[str, Any], outputs: dict[str, Any]) -> int:
    node = inputs[memory]
    if NEXT + memory not in outputs:
        raise ProgramError(f"{name}: input {memory} would be memory, and no output {NEXT}{memory} renews it")
    if node.type not in TYPES or not node.shape or len(node.shape) > 2 or not isinstance(node.shape[-1], int):
        raise ProgramError(
            f"{name}: memory {memory} is a {node.type} of shape {_shape(node)}, and must be (worlds, size)"
        )
    return node.shape[-1]


def _rows(name: str, node: Any) -> int | None:
    """Return the number of worlds that an input takes; None for any number."""
    if len(node.shape) == 1:
        return 1
    rows = node.shape[0]
    if isinstance(rows, int) and rows < 1:
        raise ProgramError(f"{name}: input {node.name} has the shape {_shape(node)}: it takes no world at all")
    return rows if isinstance(rows, int) else None


def _shape(node: Any) -> str:
    return f"({', '.join(map(str, node.shape))})"
