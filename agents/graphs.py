"""CUDA graphs: what an update repeats is recorded once for each shape of batch, and then launched as a whole.

An update is some thousand kernels of a few microseconds each; launching them one by one takes longer than they do. What
is recorded is the very function that runs everywhere else: without graphs `run(function, *args)` is `function(*args)`.

A function that may be recorded

- reads no number back from the device, and makes no decision that hangs on one; nor does it send it any, as
  `torch.where` does with a number (`masked_fill` tells the kernel);
- gets its tensors as arguments, or finds them where they always are (weights, moments, normalisers, figures), and
  changes those only in place;
- is a method of what lives as long as the graph, or a plain function: it is known by what it is.

What `run` gives is overwritten when the same function runs next. Handed on to another function it is used where it
lies; all other arguments are copied to where the graph expects them.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any, Protocol, TypeVar, TypeVarTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

T = TypeVar("T")
Ts = TypeVarTuple("Ts")

KEPT = 4  # shapes of batches; the one that was not used for longest goes first


class Run(Protocol):
    """What runs functions of tensors, or of lists and tuples of them."""

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """What the function gives."""
        ...

    def beside(self) -> "AbstractContextManager[Run]":
        """Run what happens within at the same time as what follows it, which must not need it before `meet`."""
        ...

    def meet(self) -> None:
        """Let what follows wait for what was run beside."""
        ...


class Plainly:
    """Every kernel launched by itself, one after the other: the reference."""

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """What the function gives."""
        return function(*args)

    def beside(self) -> AbstractContextManager[Run]:
        """At once, and before what follows."""
        return nullcontext(self)

    def meet(self) -> None:
        """Nothing runs beside."""


class Graphs:
    """The graphs of one learner, by the shape of the batch; none where they are off or there is no GPU."""

    def __init__(self, device: torch.device, on: bool):
        self.on = on and device.type == "cuda"
        self._lanes: tuple[Any, ...] = ()
        self._by_shape: dict[Sequence[int], Replays] = {}

    def of(self, shape: Sequence[int]) -> Run:
        """What runs functions of a batch of this shape (T, N)."""
        if not self.on:
            return Plainly()
        self._lanes = self._lanes or tuple(new_stream() for _ in range(3))
        replays = self._by_shape.pop(tuple(shape), None) or Replays(*self._lanes)
        self._by_shape[tuple(shape)] = replays
        while len(self._by_shape) > KEPT:
            del self._by_shape[next(iter(self._by_shape))]
        return replays


class Replays:
    """Runs each function for real the first time, records it the second time, and replays it from then on.

    All graphs of a shape share their memory: nothing of it outlives a replay, since arguments and results lie outside.
    What runs beside has memory of its own. It records on `stream`.
    """

    def __init__(self, stream: Any, beside: Any = None, stream_beside: Any = None):
        self._stream, self._pool = stream, None
        self._known: dict[Callable, _Recorded] = {}
        self._given: dict[int, Tensor] = {}  # by id: what functions gave, where it always lies
        if beside is not None:
            self._beside, self._other = beside, Replays(stream_beside)
            self._other._given = self._given

    def __call__(self, function: Callable[[*Ts], T], /, *args: *Ts) -> T:
        """What the function gives, in tensors that its next run overwrites."""
        known = self._known.get(function)
        if known is None:
            with on(self._stream):  # where it will be recorded, so that libraries set themselves up for it
                result = function(*args)
            wait_for(self._stream)
            known = self._known[function] = _Recorded(result)
            self._given |= {id(x): x for x in known.results}
            return known.result
        if known.replay is None:
            self._pool = self._pool or new_pool()
            known.record(function, args, self._given, self._pool, self._stream)
        known.launch(function, args)
        return known.result

    @contextmanager
    def beside(self) -> Iterator[Run]:
        """On another stream, after all that was run before."""
        with on(self._beside):
            yield self._other

    def meet(self) -> None:
        """Let what follows wait for that stream."""
        wait_for(self._beside)


class _Recorded:
    """A function's graph, the tensors that it reads and those that it writes."""

    def __init__(self, result: Any):
        self.result = pytree.tree_map_only(Tensor, lambda x: x.detach().clone(), result)
        self.results = _tensors(self.result)
        self.inputs: list[Tensor] = []
        self.owned: list[bool] = []  # whether an input is a copy of its own
        self.replay: Callable[[], None] | None = None

    def record(self, function: Callable, args: Sequence[Any], given: dict[int, Tensor], pool: Any, stream: Any) -> None:
        leaves, tree = pytree.tree_flatten(tuple(args))
        self.owned = [id(x) not in given for x in leaves]
        self.inputs = [x.detach().clone() if own else x for x, own in zip(leaves, self.owned, strict=True)]

        def recorded() -> None:
            found = _tensors(function(*pytree.tree_unflatten(self.inputs, tree)))
            for mine, new in zip(self.results, found, strict=True):
                mine.copy_(new)

        self.replay = record(recorded, pool, stream)

    def launch(self, function: Callable, args: Sequence[Any]) -> None:
        """Copy the arguments to where the graph reads them, unless they lie there, and replay it."""
        for mine, new, own in zip(self.inputs, _tensors(args), self.owned, strict=True):
            if mine is not new and not own:
                raise RuntimeError(f"{function} was recorded with the result of another run, and got something else")
            if mine is not new:
                mine.copy_(new)
        assert self.replay is not None
        self.replay()


def _tensors(tree: Any) -> list[Tensor]:
    return [x for x in pytree.tree_leaves(tree) if isinstance(x, Tensor)]


# What needs a GPU ----------------------------------------------------------------------------------------------------


def new_stream() -> Any:
    """A stream to record on, for CUDA records no default stream; or to run on beside others."""
    return torch.cuda.Stream()


def new_pool() -> Any:
    """Memory of its own for graphs."""
    return torch.cuda.graph_pool_handle()


@contextmanager
def on(stream: torch.cuda.Stream) -> Iterator[None]:
    """On a stream, after all that was launched so far."""
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        yield


def wait_for(stream: torch.cuda.Stream) -> None:
    """Let what is launched from now on wait for all that a stream has."""
    torch.cuda.current_stream().wait_stream(stream)


def record(function: Callable[[], None], pool: Any, stream: torch.cuda.Stream) -> Callable[[], None]:
    """The kernels that a function launches as a graph; they do not run yet. Gives what launches them all."""
    graph = torch.cuda.CUDAGraph()
    # Other threads are JAX's, whose allocations must not break the recording.
    with torch.cuda.graph(graph, pool=pool, stream=stream, capture_error_mode="thread_local"):
        function()
    return graph.replay
