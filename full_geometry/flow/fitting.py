"""Training of conditional flows by zuko: -E[T log p(x | context)] over walks."""

from __future__ import annotations

from functools import partial

import numpy as np
import torch
import zuko
from torch import nn

from full_geometry.flow.spline import BINS, LEAST_SLOPE

__all__ = ["HIDDEN", "FlowNetwork"]

HIDDEN = (32, 32)


class FlowNetwork(nn.Module):
    """One masked autoregressive transform of splines onto a uniform square.

    Args:
        n: dimensions.
        context: numbers that it is told.
        hidden: widths of the hidden layers.
        seed: of the numbers at the start.
    """

    def __init__(self, n: int, context: int, hidden: tuple[int, ...] = HIDDEN, seed: int = 0) -> None:
        super().__init__()
        spline = partial(zuko.transforms.MonotonicRQSTransform, bound=1.0, slope=LEAST_SLOPE)
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.transform = zuko.flows.MaskedAutoregressiveTransform(
                features=n, context=context, univariate=spline, shapes=[(BINS,), (BINS,), (BINS - 1,)],
                hidden_features=hidden,
            )  # fmt: skip
        last = self.transform.hyper[-1]
        with torch.no_grad():  # uniform at the start
            last.weight.zero_()
            last.bias.zero_()

    def log_density(self, context: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Of x (m, n) in [0, 1)^n, given context (m, inputs)."""
        return self.transform(context).call_and_ladj(2 * x - 1)[1]

    def arrays(self) -> dict[str, np.ndarray]:
        """Matrices F_k with their masks multiplied in, and biases h_k."""
        found, layers = {}, [m for m in self.transform.hyper if hasattr(m, "weight")]
        for k, layer in enumerate(layers):
            found[f"F_{k}"] = (layer.mask * layer.weight).detach().numpy().copy()
            found[f"h_{k}"] = layer.bias.detach().numpy().copy()
        return found
