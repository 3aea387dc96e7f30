"""CUDA graphs: the repeated parts of an update are captured once for each batch shape and then launched as a whole.

An update consists of some thousand kernels of a few microseconds each; launching them one by one takes longer than
running them. The captured function is the one that runs everywhere else: without graphs `run(function, *args)` is
`function(*args)`.

A function that may be captured

- reads no number back from the device and makes no decision that depends on one. It sends none to the device either, as
  `torch.where` does with a Python number (`masked_fill` passes it to the kernel);
- receives its tensors as arguments or finds them at a fixed address (weights, moments, normalisers, metrics), and
  changes those only in place;
- is a plain function or a method of an object that lives as long as the graph, because graphs are found by function.

The next run of a function overwrites its results. A result that is passed to another function is used in place; all
other arguments are copied to the addresses that the graph reads.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol, TypeVar, TypeVarTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

MAX_SHAPES = 4  # of batches whose graphs are kept; the least recently used one goes first


class Runner(Protocol):
    """Runs functions whose arguments are tensors, or lists and tuples of tensors."""

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """Return the function's result."""
        ...

    def concurrently(self) -> "AbstractContextManager[Runner]":
        """Run the block at the same time as the code after it, which must not use its results before `wait`."""
        ...

    def wait(self) -> None:
        """Let the following work wait for the concurrent block."""
        ...


class EagerRunner:
    """Launches all kernels one by one, in order: the reference."""

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """Return the function's result."""
        return function(*args)

    def concurrently(self) -> AbstractContextManager[Runner]:
        """Run the block at once, before the code after it."""
        return nullcontext(self)

    def wait(self) -> None:
        """Do nothing: no work is concurrent."""


class GraphCache:
    """The graph runners of one learner by batch shape; eager runners without a GPU or with graphs off."""

    def __init__(self, device: torch.device, on: bool):
        self.on = on and device.type == "cuda"
        self._lanes: tuple[Any, ...] = ()
        self._by_shape: dict[Sequence[int], GraphRunner] = {}

    def for_shape(self, shape: Sequence[int]) -> Runner:
        """Return the runner for batches of this shape (T, N)."""
        if not self.on:
            return EagerRunner()
        self._lanes = self._lanes or tuple(new_stream() for _ in range(3))
        replays = self._by_shape.pop(tuple(shape), None) or GraphRunner(*self._lanes)
        self._by_shape[tuple(shape)] = replays
        while len(self._by_shape) > MAX_SHAPES:
            del self._by_shape[next(iter(self._by_shape))]
        return replays


class GraphRunner:
    """Runs each function eagerly the first time, captures it the second time, and replays it from then on.

    All graphs of a shape share one memory pool: nothing in it outlives a replay, because arguments and results lie
    outside. The concurrent runner has a pool of its own. Capture happens on `stream`.
    """

    def __init__(self, stream: Any, concurrently: Any = None, stream_beside: Any = None):
        self._stream, self._pool = stream, None
        self._known: dict[Callable, _FunctionGraph] = {}
        self._given: dict[int, Tensor] = {}  # by id: results of functions, at fixed addresses
        if concurrently is not None:
            self._beside, self._other = concurrently, GraphRunner(stream_beside)
            self._other._given = self._given

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """Return the function's result, in tensors that its next run overwrites."""
        known = self._known.get(function)
        if known is None:
            with on(self._stream):  # on the stream of the capture, so that libraries initialise themselves for it
                result = function(*args)
            wait_for(self._stream)
            known = self._known[function] = _FunctionGraph(result)
            self._given |= {id(x): x for x in known.results}
            return known.result
        if known.replay is None:
            self._pool = self._pool or new_pool()
            known.record(function, args, self._given, self._pool, self._stream)
        known.launch(function, args)
        return known.result

    @contextmanager
    def concurrently(self) -> Iterator[Runner]:
        """Run the block on another stream, after all earlier work."""
        with on(self._beside):
            yield self._other

    def wait(self) -> None:
        """Let the following work wait for that stream."""
        wait_for(self._beside)


class _FunctionGraph:
    """The graph of a function, the tensors that it reads and those that it writes."""

    def __init__(self, result: Any):
        self.result = pytree.tree_map_only(Tensor, lambda x: x.detach().clone(), result)
        self.results = _tensors(self.result)
        self.inputs: list[Tensor] = []
        self.owned: list[bool] = []  # for each input: it is a copy that belongs to the graph
        self.replay: Callable[[], None] | None = None

    def record(self, function: Callable, args: Sequence[Any], given: dict[int, Tensor], pool: Any, stream: Any) -> None:
        leaves, tree = pytree.tree_flatten(tuple(args))
        self.owned = [id(x) not in given for x in leaves]
        self.inputs = [x.detach().clone() if own else x for x, own in zip(leaves, self.owned, strict=True)]

        def recorded() -> None:
            found = _tensors(function(*pytree.tree_unflatten(self.inputs, tree)))
            for target, new in zip(self.results, found, strict=True):
                target.copy_(new)

        self.replay = record(recorded, pool, stream)

    def launch(self, function: Callable, args: Sequence[Any]) -> None:
        """Copy arguments to the addresses that the graph reads, unless they are there already, and replay it."""
        for target, new, own in zip(self.inputs, _tensors(args), self.owned, strict=True):
            if target is not new and not own:
                raise RuntimeError(f"{function} was recorded with the result of another run, and got something else")
            if target is not new:
                target.copy_(new)
        assert self.replay is not None
        self.replay()


def _tensors(tree: Any) -> list[Tensor]:
    return [x for x in pytree.tree_leaves(tree) if isinstance(x, Tensor)]


# The functions below need a GPU ---------------------------------------------------------------------------------------


def new_stream() -> Any:
    """Return a stream for captures, which CUDA does not allow on the default stream, or for concurrent work."""
    return torch.cuda.Stream()


def new_pool() -> Any:
    """Return a memory pool for graphs."""
    return torch.cuda.graph_pool_handle()


@contextmanager
def on(stream: torch.cuda.Stream) -> Iterator[None]:
    """Run the block on a stream, after all work launched so far."""
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        yield


def wait_for(stream: torch.cuda.Stream) -> None:
    """Let the following work wait for all work of a stream."""
    torch.cuda.current_stream().wait_stream(stream)


def record(function: Callable[[], None], pool: Any, stream: torch.cuda.Stream) -> Callable[[], None]:
    """Capture the kernels that a function launches, without running them. Returns a function that launches them all."""
    graph = torch.cuda.CUDAGraph()
    # JAX allocates memory in other threads; that must not break the capture.
    with torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
        function()
    return graph.replay
