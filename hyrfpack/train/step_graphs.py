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

# A graph may take this share of the free memory.
MAX_GRAPH_MEMORY_SHARE = 0.7
# Graphs are given up where less than this share of the largest amount that was in use is free.
MIN_FREE_MEMORY_SHARE = 0.25
MAX_GRAPHS = 4  # Each holds memory for all that a step computes. Steps of further shapes are launched as usual.
# Gradients of hash tables are sums in any order, so that equal steps differ by rounding.
MAX_GRADIENT_DIFFERENCE = 1e-3
MAX_LOSS_DIFFERENCE = 1e-5

Compute = Callable[[StepShape, StepInputs], ViewGradients]
Replay = Callable[[], object]
Result = TypeVar("Result")


class GraphCapturer:
    """Captures CUDA graphs, which share one pool of memory and are replayed one after the other."""

    def __init__(self) -> None:
        self._stream = torch.cuda.Stream()
        self._pool = torch.cuda.graph_pool_handle()
        # The pool lives as long as one of its graphs. So memory of earlier graphs is used again.
        self._keeper, _ = self._capture(lambda: torch.zeros(1, device="cuda"))

    def has_room(self) -> bool:
        """Return whether the GPU has free memory for a graph, which takes about as much as a step that is launched.

        Memory that torch keeps without using it does not count, because torch cannot free it during a capture.
        """
        return torch.cuda.max_memory_allocated() <= MAX_GRAPH_MEMORY_SHARE * torch.cuda.mem_get_info()[0]

    def is_memory_short(self) -> bool:
        """Return whether other work may soon need the memory of graphs."""
        return torch.cuda.mem_get_info()[0] < MIN_FREE_MEMORY_SHARE * torch.cuda.max_memory_allocated()

    def capture(self, launch: Callable[[], ViewGradients]) -> tuple[ViewGradients, Replay]:
        """Capture what a function launches. It runs nothing; its results are undefined before the first replay.

        Raises:
            RuntimeError: CUDA cannot capture a launch.
            torch.OutOfMemoryError: there is too little memory.
        """
        graph, result = self._capture(launch)
        return result, graph.replay

    def _capture(self, launch: Callable[[], Result]) -> tuple[torch.cuda.CUDAGraph, Result]:
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
    """A captured step: the memory of its inputs and results, and its replay."""

    inputs: StepInputs
    result: ViewGradients
    replay: Replay

    def run(self, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients from these inputs, into the same memory as all replays of this graph."""
        start = time.perf_counter()
        for fixed, given in zip(_tensors(self.inputs), _tensors(inputs), strict=True):
            fixed.copy_(given)
        self.replay()
        return replace(self.result, seconds={"replay": time.perf_counter() - start})


class StepGraphs:
    """Computes the gradients of steps, by graphs where the same work was launched before."""

    def __init__(self) -> None:
        self._capturer: GraphCapturer | None = None
        self._graphs: dict[StepShape, _StepGraph] = {}
        self._launched: set[StepShape] = set()  # Kernels are compiled at the first launch, which cannot be captured.
        self._is_compared, self._is_usable = False, True

    def clear(self) -> None:
        """Forget all graphs, because parameters are to be replaced.

        Their memory is kept for later graphs, unless other work may soon need it.
        """
        self._graphs.clear()
        self._launched.clear()
        if self._capturer is not None and self._capturer.is_memory_short():
            self.release()

    def release(self) -> None:
        """Forget all graphs, and free their memory."""
        self._graphs.clear()
        self._launched.clear()
        if self._capturer is not None:
            self._capturer = None
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
            graph = self._capture(compute, shape, inputs)
            if graph is None:
                return self._launch(compute, shape, inputs)
            self._graphs[shape] = graph
        return graph.run(inputs) if self._is_compared else self._compare(graph, compute, shape, inputs)

    def _launch(self, compute: Compute, shape: StepShape, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients without a graph; if memory runs out while graphs hold some, give them up first."""
        try:
            return compute(shape, inputs)
        except (RuntimeError, HyrfError) as error:
            if self._capturer is None or not has_run_out_of_memory(error):
                raise
        self._give_up()
        return compute(shape, inputs)

    def _capture(self, compute: Compute, shape: StepShape, inputs: StepInputs) -> _StepGraph | None:
        """Capture the graph of a shape; return None if there are enough or memory is short.

        None is also returned if the capture fails, and then no others are captured.
        """
        for other in [other for other in self._graphs if replace(other, reserve=shape.reserve) == shape]:
            del self._graphs[other]  # The estimate of its reserve has changed.
        if len(self._graphs) >= MAX_GRAPHS:
            return None
        try:
            self._capturer = self._capturer or GraphCapturer()
            if not self._capturer.has_room():
                return None
            fixed = _copy_inputs(inputs)
            result, replay = self._capturer.capture(lambda: compute(shape, fixed))
        except (RuntimeError, HyrfError) as error:  # All problems of CUDA, and those of its memory as rendering says.
            if has_run_out_of_memory(error):
                self._give_up()
            else:
                self._end(f"training steps cannot be captured as CUDA graphs here ({short_reason(error)})")
            return None
        return _StepGraph(fixed, result, replay)

    def _compare(self, graph: _StepGraph, compute: Compute, shape: StepShape, inputs: StepInputs) -> ViewGradients:
        """Compute the gradients with and without the graph; if they differ, use no graphs from now on."""
        self._is_compared = True
        expected = self._launch(compute, shape, inputs)
        if not self._is_usable:
            return expected
        replayed = graph.run(inputs)
        is_near = _is_near(expected.loss, replayed.loss, MAX_LOSS_DIFFERENCE)
        for wanted, gradient in zip(expected.gradients, replayed.gradients, strict=True):
            if wanted is not None and gradient is not None:
                is_near &= _is_near(wanted, gradient, MAX_GRADIENT_DIFFERENCE)
        if is_near:
            return replayed
        self._end("a training step captured as a CUDA graph has other gradients than without one")
        return expected

    def _give_up(self) -> None:
        """Free all memory of graphs, and capture no others."""
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


def _is_near(wanted: Tensor, actual: Tensor, difference: float) -> bool:
    """Return whether two tensors differ by at most this share of their length, or what is wanted is not finite."""
    distance, length = torch.linalg.vector_norm(actual - wanted).item(), torch.linalg.vector_norm(wanted).item()
    return distance <= difference * length or not length < float("inf")
