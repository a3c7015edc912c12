"""Recording a stretch of torch and Warp work as one CUDA graph. On the CPU the same function runs as it is written."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from worker.simulation.capture import garbage_collection_paused


class CudaGraphFunction:
    """A function without arguments that a CUDA device replays as one graph.

    The first call runs it as it is (kernels are loaded, lazy buffers made, and the work is done), the second one records it, and
    every later call replays the record: one launch, whatever is in it. So the function must

    - touch only tensors that stay where they are, and Python values that stay what they are;
    - never ask the device for a value, which a recording refuses with an error;
    - draw no random numbers (fill a buffer with them beforehand).

    Args:
        function: What to do.
        device: ``"cpu"``, where :meth:`__call__` always runs ``function``, or ``"cuda:<n>"``.
        name: For the run's log.
    """

    def __init__(self, function: Callable[[], None], device: str, name: str) -> None:
        self._function, self.name = function, name
        self._cuda = device.startswith("cuda")
        self._ran = False
        self._graph: torch.cuda.CUDAGraph | None = None
        self.seconds = 0.0
        """How long recording took [s]."""

    @property
    def can_be_captured(self) -> bool:
        """Whether it will be, sooner or later."""
        return self._cuda

    @property
    def captured(self) -> bool:
        """Whether calls replay a graph by now."""
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
        """Forget the graph. A process group must not be left while a graph holds its collectives: NCCL would wait for ever."""
        if self._graph is not None:
            self._graph.reset()
            self._graph = None

    def _record(self) -> torch.cuda.CUDAGraph:
        started = time.perf_counter()
        graph = torch.cuda.CUDAGraph()
        # on the stream of the first call, where autograd expects the gradients; NCCL's watchdog thread asks events meanwhile
        graphed = torch.cuda.graph(graph, stream=torch.cuda.current_stream(), capture_error_mode="thread_local")
        with garbage_collection_paused(), graphed:
            self._function()
        self.seconds = time.perf_counter() - started
        return graph


class Readback:
    """Brings a few numbers to the host: the one place where an iteration waits for the device."""

    def __init__(self, device: str) -> None:
        self._cuda = device.startswith("cuda")
        self._pinned: torch.Tensor | None = None

    def read(self, numbers: torch.Tensor) -> list[float]:
        """The values of ``numbers``, shape (n,), once the device has come so far."""
        if not self._cuda:
            return numbers.tolist()
        if self._pinned is None:
            self._pinned = torch.empty_like(numbers, device="cpu", pin_memory=True)
        self._pinned.copy_(numbers, non_blocking=True)
        arrived = torch.cuda.Event(blocking=True)  # the core that waits sleeps
        arrived.record()
        arrived.synchronize()
        return self._pinned.tolist()
