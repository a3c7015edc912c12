"""Capture a sequence of torch and Warp work as one CUDA graph. On the CPU the same function runs eagerly."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from worker.simulation.capture import garbage_collection_paused


class CudaGraphFunction:
    """A function without arguments that a CUDA device replays as one graph.

    The first call runs it eagerly (which loads kernels and allocates lazy buffers), the second call captures it, and every later call
    replays the graph with a single launch. So the function must

    - touch only tensors with fixed addresses, and Python values that do not change;
    - never read a value back from the device, which is an error during a capture;
    - draw no random numbers (fill a buffer with them beforehand).

    Args:
        function: The function.
        device: ``"cpu"``, where :meth:`__call__` always runs ``function``, or ``"cuda:<n>"``.
        name: For the run's log.
    """

    def __init__(self, function: Callable[[], None], device: str, name: str) -> None:
        self._function, self.name = function, name
        self._cuda = device.startswith("cuda")
        self._ran = False
        self._graph: torch.cuda.CUDAGraph | None = None
        self.seconds = 0.0
        """Duration of the capture [s]."""

    @property
    def can_be_captured(self) -> bool:
        """Whether a later call can capture it."""
        return self._cuda

    @property
    def captured(self) -> bool:
        """Whether calls now replay a graph."""
        return self._graph is not None

    def __call__(self) -> None:
        if self._graph is None:
            if not self._cuda or not self._ran:
                self._function()
                self._ran = True
                return
            self._graph = self._record()
        self._graph.replay()

    def release(self) -> None:
        """Delete the graph. Do so before leaving a process group whose collectives it holds: NCCL would wait forever."""
        if self._graph is not None:
            self._graph.reset()
            self._graph = None

    def _record(self) -> torch.cuda.CUDAGraph:
        started = time.perf_counter()
        graph = torch.cuda.CUDAGraph()
        # on the stream of the first call, where autograd expects the gradients; NCCL's watchdog thread queries events meanwhile
        graphed = torch.cuda.graph(graph, stream=torch.cuda.current_stream(), capture_error_mode="thread_local")
        with garbage_collection_paused(), graphed:
            self._function()
        self.seconds = time.perf_counter() - started
        return graph
