"""Steps on CUDA that are recorded once and then replayed, instead of handed over kernel by kernel."""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sattools.fit.adam import Adam

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Recording:
    """A recorded step: numbers ``[R]`` of its rays are read from `chosen`, its loss is left in `loss`."""

    graph: torch.cuda.CUDAGraph
    chosen: Tensor
    loss: Tensor


class RecordedSteps:
    """Steps of a training, each phase of it recorded when it has been met once.

    A step of a field asks for several hundred kernels of some microseconds each: Python and the driver take ten times
    as long to ask for them as the card to run them. So the first step of a phase, and of a number of rays, is done as
    it is, which makes whatever is made but once; the second is recorded as a CUDA graph; from then on the graph is
    replayed, with other rays, rates and random numbers. If it cannot be recorded, every step is done as it is, and
    that is said.

    Args:
        device: a CUDA device.
        adam: ``capturable``; its rates become tensors that the recordings read.
    """

    def __init__(self, device: torch.device, adam: Adam) -> None:
        self.adam, self.met = adam, set[Hashable]()
        self.recordings: dict[Hashable, _Recording] = {}
        self.stream = torch.cuda.Stream(device)  # work that is recorded may not lie on the default one
        self.rates = torch.zeros(len(adam.param_groups), device=device)
        for group, rate in zip(adam.param_groups, self.rates, strict=True):
            group["lr"] = rate
        self.possible = True

    def step(
        self,
        phase: Hashable,
        chosen: Tensor,
        rates: Sequence[float],
        descend: Callable[[Tensor], Tensor],
        random: torch.Generator,
    ) -> Tensor:
        """One step; its loss.

        Args:
            phase: in which `descend` does the same with all numbers of rays.
            chosen: ``[R]`` numbers of the rays.
            rates: of Adam's groups.
            descend: the step with rays of these numbers; its loss. It waits for nothing on the device.
            random: what it draws from, on the device.
        """
        self.rates.copy_(torch.tensor(rates, device="cpu"))
        key = phase, len(chosen)
        self.stream.wait_stream(torch.cuda.current_stream(self.stream.device))
        with torch.cuda.stream(self.stream):
            if key in self.met and key not in self.recordings and self.possible:
                self._record(key, chosen, descend, random)
            self.met.add(key)
            recording = self.recordings.get(key)
            if recording is None:
                loss = descend(chosen)
            else:
                recording.chosen.copy_(chosen)
                recording.graph.replay()
                loss = recording.loss
        torch.cuda.current_stream(self.stream.device).wait_stream(self.stream)
        return loss

    def _record(
        self, key: Hashable, chosen: Tensor, descend: Callable[[Tensor], Tensor], random: torch.Generator
    ) -> None:
        graph, own = torch.cuda.CUDAGraph(), chosen.clone()
        graph.register_generator_state(random)
        pool = next((r.graph.pool() for r in self.recordings.values()), None)
        try:
            with torch.cuda.graph(graph, pool=pool, stream=self.stream):
                loss = descend(own)
        except RuntimeError as error:
            self.possible = False
            log.warning("steps are not recorded and take longer: %s", str(error).splitlines()[0])
            return
        self.recordings[key] = _Recording(graph, own, loss)

    def forget(self) -> None:
        """Record anew, as tensors that had been recorded are others now."""
        self.met.clear()
        self.recordings.clear()


__all__ = ["RecordedSteps"]
