"""Means of metrics over minibatches, accumulated on the device.

Only `read_means` reads numbers back from the device, so CUDA graphs can replay everything before it
(`agents/devices/cuda_graphs.py`).
"""

from collections.abc import Sequence

import torch
from torch import Tensor


class MetricSums:
    """Sums of metrics over minibatches, on the device: to read each metric, a GPU would wait a hundred times."""

    def __init__(self, names: Sequence[str], device: torch.device):
        self.names, self.sums = tuple(names), torch.zeros(len(names) + 1, device=device)  # the last one counts

    def add(self, valid: Tensor, **values: Tensor) -> None:
        """Add each metric () if `valid` () is 1 and not 0; all must be finite in either case."""
        each = [values[name].detach().float() for name in self.names]
        self.sums.addcmul_(torch.stack([*each, valid]), valid)

    def mean(self, name: str, since: Tensor) -> Tensor:
        """Return the mean () of a metric over everything added after the sums were `since`; 0 if nothing was."""
        added = self.sums - since
        return added[self.names.index(name)] / added[-1].clamp(min=1.0)


def read_means(all_sums: Sequence[MetricSums]) -> dict[str, float]:
    """Return each metric's mean over all sums that have it, read at once, without metrics that were never added."""
    found: dict[str, tuple[float, float]] = {}
    totals = torch.cat([metric_sums.sums for metric_sums in all_sums]).tolist()
    for metric_sums in all_sums:
        *sums, count = (totals.pop(0) for _ in metric_sums.sums)
        for name, total in zip(metric_sums.names, sums, strict=True):
            before = found.get(name, (0.0, 0.0))
            found[name] = before[0] + total, before[1] + count
    return {name: total / count for name, (total, count) in found.items() if count}
