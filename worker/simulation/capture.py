"""The capture of a sequence of Warp launches: recorded once and replayed, on CPU and CUDA."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Callable, Iterator

import torch
import warp as wp


@contextlib.contextmanager
def garbage_collection_paused() -> Iterator[None]:
    """Pause garbage collection while a graph is recorded: a finaliser that frees an array would be recorded too, or would break the
    recording."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


@contextlib.contextmanager
def on_torch_stream(device: str) -> Iterator[wp.Stream | None]:
    """Make Warp launch on torch's current stream, so that no synchronisation between them is needed.

    Args:
        device: ``"cpu"`` (nothing to do) or ``"cuda:<n>"``.

    Yields:
        The stream, or None on the CPU.
    """
    if not device.startswith("cuda"):
        yield None
        return
    stream = wp.stream_from_torch(torch.cuda.current_stream(device))
    with wp.ScopedStream(stream, sync_enter=False):
        yield stream


class CapturedStep:
    """One function of Warp launches, recorded at construction and replayed by :meth:`launch`.

    The function must touch only arrays that live as long as this object and must not read anything back to the host.
    It must have run once before, so that every kernel module is loaded.

    Args:
        function: Launches kernels, nothing else.
        device: ``"cpu"`` or ``"cuda:<n>"``.
    """

    def __init__(self, function: Callable[[], None], device: str) -> None:
        self._function = function
        self._device = device
        self._is_cuda = device.startswith("cuda")
        if self._is_cuda:
            torch.cuda.synchronize(device)
        # The legacy default stream of CUDA cannot be captured: record on a stream of our own, replay on torch's.
        stream = wp.Stream(device) if self._is_cuda else None
        scope = wp.ScopedStream(stream) if stream is not None else contextlib.nullcontext()
        with garbage_collection_paused(), scope, wp.ScopedCapture(device=device, stream=stream) as capture:
            function()
        self._graph = capture.graph
        self._parts_of_others: list[wp.Graph] = []
        if self._is_cuda:
            torch.cuda.synchronize(device)

    def launch(self) -> None:
        """Replay the recording on torch's current stream; inside a torch CUDA graph capture, become part of it."""
        if not self._is_cuda:
            wp.capture_launch(self._graph)
            return
        with on_torch_stream(self._device) as stream:
            if torch.cuda.is_current_stream_capturing():
                # mujoco_warp's solver loop is a conditional node, which a child graph may not hold: record it afresh.
                with garbage_collection_paused(), wp.ScopedCapture(stream=stream, external=True) as part:
                    self._function()
                # Holds the kernels that torch's graph launches.
                self._parts_of_others.append(part.graph)
            else:
                wp.capture_launch(self._graph, stream=stream)
