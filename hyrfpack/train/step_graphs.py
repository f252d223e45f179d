"""Replays a training step's launches as CUDA graphs.

On small scenes the host takes ten times as long to launch a step's kernels as a GPU to run them. A graph holds the
launches of one step with all their arguments, and the host replays them with one call. What differs between steps is
copied into fixed memory before: photo, camera and background colour (`StepInputs`). All else that a launch takes from
the host is part of the `StepShape`, so each shape has a graph of its own. Density control replaces the parameters,
whose addresses graphs hold, and so ends all graphs.

A mistake in this would show as plausible, wrong gradients. So a trainer's first replay is compared with the same step
launched as usual.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from hyrfpack.errors import HyrfError, short_reason
from hyrfpack.ops.viewport import PackedCamera
from hyrfpack.out_of_memory import has_run_out_of_memory
from hyrfpack.train.gradients import StepInputs, StepShape, ViewGradients

_LOG = logging.getLogger(__name__)

# Of the free memory. Of the largest amount that was in use, this share stays free, or all graphs are given up.
MAX_GRAPH_MEMORY_SHARE, MIN_FREE_MEMORY_SHARE = 0.7, 0.25
MAX_GRAPHS = 4  # Each holds memory for all that a step computes. Steps of further shapes are launched as usual.
# Gradients of hash tables are sums in any order, so that equal steps differ by rounding.
MAX_GRADIENT_DIFFERENCE = 1e-3
MAX_LOSS_DIFFERENCE = 1e-5

Compute = Callable[[StepShape, StepInputs], ViewGradients]
Replay = Callable[[], object]
Result = TypeVar("Result")


class GraphRecorder:
    """Records CUDA graphs, which share one pool of memory and are replayed one after the other."""

    def __init__(self) -> None:
        self._stream = torch.cuda.Stream()
        self._pool = torch.cuda.graph_pool_handle()
        # The pool lives as long as one of its graphs. So memory of earlier graphs is used again.
        self._keeper, _ = self._record(lambda: torch.zeros(1, device="cuda"))

    def has_room(self) -> bool:
        """Return whether the GPU has free memory for a graph, which takes about as much as a step that is launched.

        Memory that torch keeps without using it does not count, because torch cannot free it during a recording.
        """
        return torch.cuda.max_memory_allocated() <= MAX_GRAPH_MEMORY_SHARE * torch.cuda.mem_get_info()[0]

    def is_memory_short(self) -> bool:
        """Return whether other work may soon need the memory of graphs."""
        return torch.cuda.mem_get_info()[0] < MIN_FREE_MEMORY_SHARE * torch.cuda.max_memory_allocated()

    def record(self, launch: Callable[[], ViewGradients]) -> tuple[ViewGradients, Replay]:
        """Record what a function launches. It runs nothing; its results are undefined before the first replay.

        Raises:
            RuntimeError: CUDA cannot record a launch.
            torch.OutOfMemoryError: there is too little memory.
        """
        graph, result = self._record(launch)
        return result, graph.replay

    def _record(self, launch: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
        graph, current = torch.cuda.CUDAGraph(), torch.cuda.current_stream()
        self._stream.wait_stream(current)
        with torch.cuda.stream(self._stream):
            # Other threads may use CUDA meanwhile, such as the one that computes gradients.
            graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
            try:
                result = launch()
            except BaseException:
                with suppress(RuntimeError):
                    graph.capture_end()
                raise
            graph.capture_end()
        current.wait_stream(self._stream)
        return graph, result


@dataclass(frozen=True)
class _StepGraph:
    """A recorded step: the memory of its inputs and results, and its replay."""

    inputs: StepInputs
    found: ViewGradients
    replay: Replay

    def run(self, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients from these inputs, into the same memory as all replays of this graph."""
        start = time.perf_counter()
        for kept, given in zip(_tensors(self.inputs), _tensors(inputs), strict=True):
            kept.copy_(given)
        self.replay()
        return replace(self.found, seconds={"replay": time.perf_counter() - start})


class StepGraphs:
    """Computes the gradients of steps, by graphs where the same work was launched before."""

    def __init__(self) -> None:
        self._recorder: GraphRecorder | None = None
        self._graphs: dict[StepShape, _StepGraph] = {}
        self._launched: set[StepShape] = set()  # Kernels are compiled at the first launch, which cannot be recorded.
        self._is_compared, self._is_usable = False, True

    def clear(self) -> None:
        """Forget all graphs, because parameters are to be replaced.

        Their memory is kept for later graphs, unless other work may soon need it.
        """
        self._graphs.clear()
        self._launched.clear()
        if self._recorder is not None and self._recorder.is_memory_short():
            self.release()

    def release(self) -> None:
        """Forget all graphs, and free their memory."""
        self._graphs.clear()
        self._launched.clear()
        if self._recorder is not None:
            self._recorder = None
            torch.cuda.empty_cache()

    def run(self, compute: Compute, shape: StepShape, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients of a step. The next call overwrites the result.

        Args:
            compute: computes the gradients. All launches take their numbers from its arguments, and their other
                addresses stay the same until `clear`.
        """
        graph = self._graphs.get(shape)
        if graph is None:
            is_first = shape not in self._launched
            self._launched.add(shape)
            if not self._is_usable or is_first:
                return self._launch(compute, shape, inputs)
            graph = self._record(compute, shape, inputs)
            if graph is None:
                return self._launch(compute, shape, inputs)
            self._graphs[shape] = graph
        return graph.run(inputs) if self._is_compared else self._compare(graph, compute, shape, inputs)

    def _launch(self, compute: Compute, shape: StepShape, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients without a graph; if memory runs out while graphs hold some, give them up first."""
        try:
            return compute(shape, inputs)
        except (RuntimeError, HyrfError) as error:
            if self._recorder is None or not has_run_out_of_memory(error):
                raise
        self._give_up()
        return compute(shape, inputs)

    def _record(self, compute: Compute, shape: StepShape, inputs: StepInputs) -> _StepGraph | None:
        """Record the graph of a shape; return None if there are enough or memory is short.

        None is also returned if recording fails, and then no others are recorded.
        """
        for other in [other for other in self._graphs if replace(other, reserve=shape.reserve) == shape]:
            del self._graphs[other]  # The estimate of its reserve has changed.
        if len(self._graphs) >= MAX_GRAPHS:
            return None
        try:
            self._recorder = self._recorder or GraphRecorder()
            if not self._recorder.has_room():
                return None
            kept = _copy_inputs(inputs)
            found, replay = self._recorder.record(lambda: compute(shape, kept))
        except (RuntimeError, HyrfError) as error:  # All problems of CUDA, and those of its memory as rendering says.
            if has_run_out_of_memory(error):
                self._give_up()
            else:
                self._end(f"training steps cannot be recorded as CUDA graphs here ({short_reason(error)})")
            return None
        return _StepGraph(kept, found, replay)

    def _compare(self, graph: _StepGraph, compute: Compute, shape: StepShape, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients with and without the graph; if they differ, use no graphs from now on."""
        self._is_compared = True
        expected = self._launch(compute, shape, inputs)
        if not self._is_usable:
            return expected
        found = graph.run(inputs)
        is_near = _is_near(expected.loss, found.loss, MAX_LOSS_DIFFERENCE)
        for wanted, replayed in zip(expected.gradients, found.gradients, strict=True):
            if wanted is not None and replayed is not None:
                is_near &= _is_near(wanted, replayed, MAX_GRADIENT_DIFFERENCE)
        if is_near:
            return found
        self._end("a training step recorded as a CUDA graph has other gradients than without one")
        return expected

    def _give_up(self) -> None:
        """Free all memory of graphs, and record no others."""
        self.release()
        self._is_usable = False

    def _end(self, problem: str) -> None:
        self._give_up()
        _LOG.warning(
            f"{problem}, so each step launches its kernels one by one, which is slower on small scenes; please report "
            "this, with the output of 'hyrfpack doctor'"
        )


def _tensors(inputs: StepInputs) -> list[Tensor]:
    """Return the tensors of the inputs, without None."""
    single = [inputs.target, inputs.mask, inputs.solid, inputs.photo_row, *(inputs.camera or ())]
    return [tensor for tensor in single if tensor is not None]


def _copy_inputs(inputs: StepInputs) -> StepInputs:
    """Return copies of all inputs, in memory of their own."""

    def copy(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor.clone()

    camera = None if inputs.camera is None else PackedCamera(*(tensor.clone() for tensor in inputs.camera))
    return StepInputs(inputs.target.clone(), copy(inputs.mask), copy(inputs.solid), copy(inputs.photo_row), camera)


def _is_near(wanted: Tensor, found: Tensor, difference: float) -> bool:
    """Return whether two tensors differ by at most this share of their length, or what is wanted is not finite."""
    distance, length = torch.linalg.vector_norm(found - wanted).item(), torch.linalg.vector_norm(wanted).item()
    return distance <= difference * length or not length < float("inf")
