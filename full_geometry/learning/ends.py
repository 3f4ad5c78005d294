"""What steps leave of the ends of pairs, solved for at the end: quadratic functions of exit and of entry.

Along some directions, such as what surrounds an end, the loss of single pairs is so flat and noisy that steps do not
get there. With phi the `Terms` of an end, of a pair the sum of both, f becomes f + c . phi by a Newton step

    c = (H + r)^-1 (E[T phi] - E[V phi]),    H = E[V phi phi^T],

T of walks, V the light of proposals as the fit has it, after which both agree in every one of the terms. T does not
know the fit, so that E[T phi] is over all walks that it has seen. r keeps small what these do not tell.
"""

from __future__ import annotations

import numpy as np
import torch

from full_geometry.features import Terms

__all__ = ["Ends"]

RIDGE = 1e6  # times 1/n of walks and of proposals, effective numbers, is r over the diagonal of H
SAMPLE = 2**14  # pairs that H is taken over
BLOCK = 8192  # columns at once


class Ends:
    """Sums over walks and proposals of some channels.

    Args:
        channels: of the medium.
        n: features of a side.
        device: of everything.
    """

    def __init__(self, channels: int, n: int, device: torch.device) -> None:
        self.n = n
        self.heads, self.rows, self.cols = (torch.from_numpy(v).to(device) for v in Terms.of(n))
        p = len(self.rows)
        self.walked, self.lit = (torch.zeros(channels, p, device=device) for _ in range(2))
        # sums of T and V, and of their squares; numbers
        self.of_T, self.of_V = (torch.zeros(2, channels, device=device) for _ in range(2))
        self.drawn, self.proposed = torch.zeros(1, device=device), 0
        self.curve = torch.eye(p, device=device).repeat(channels, 1, 1)  # H

    def tensors(self) -> dict[str, torch.Tensor]:
        """What is known of walks, by name."""
        return {f"ends.{name}": getattr(self, name) for name in ("walked", "of_T", "drawn")}

    def add_walks(self, x: torch.Tensor, T: torch.Tensor, drawn: int) -> None:
        """Walks of random exits, of so many that were drawn: features (inputs, columns), T (channels, columns)."""
        self.of_T += _moments(T)
        self.drawn += drawn
        self.walked += self._sums(x, T)

    def add_proposals(self, x: torch.Tensor, V: torch.Tensor) -> None:
        """Proposals for random exits, V (channels, columns) with the light as its mean."""
        if self.proposed == 0:
            self._curve(x[:, :SAMPLE], V[:, :SAMPLE])
        self.of_V += _moments(V)
        self.proposed += V.shape[1]
        self.lit += self._sums(x, V)

    def solved(self) -> np.ndarray:
        """c, (channels, products); 0 without proposals."""
        lit, walked = self.lit.double() / max(self.proposed, 1), self.walked.double() / self.drawn.clamp_min(1.0)
        noise = sum(squares / total.clamp_min(1e-30) ** 2 for total, squares in (self.of_T, self.of_V))
        c = torch.zeros_like(lit)
        for k in torch.nonzero((self.of_V[0] > 0) & (self.of_T[0] > 0))[:, 0].tolist():
            H = self.curve[k].double()
            scale = H.diagonal().clamp_min(1e-12).rsqrt()
            H = H * scale[:, None] * scale
            H += torch.diag(H.new_full((len(H),), RIDGE * float(noise[k])))
            light = self.of_V[0, k] / self.proposed
            c[k] = scale * torch.linalg.solve(H, scale * (walked[k] - lit[k]) / light)
        return c.float().cpu().numpy()

    def _sides(self, x: torch.Tensor) -> list[torch.Tensor]:
        """(1, features) of both ends."""
        one = torch.ones(1, x.shape[1], device=x.device)
        return [torch.cat([one, x[k * self.n : (k + 1) * self.n]]) for k in range(2)]

    def _sums(self, x: torch.Tensor, value: torch.Tensor) -> torch.Tensor:
        """Sums over columns of value times the terms of both ends, (channels, products)."""
        found = torch.zeros(len(value), len(self.heads), self.n + 1, device=x.device)
        for part, v in zip(x.split(BLOCK, dim=1), value.split(BLOCK, dim=1)):
            for s in self._sides(part):
                for k, w in enumerate(v):
                    found[k].addmm_(s[self.heads] * w, s.T)
        return found[:, self.rows, self.cols]

    def _curve(self, x: torch.Tensor, V: torch.Tensor) -> None:
        """H of each channel."""
        phi = sum(s[self.heads][self.rows] * s[self.cols] for s in self._sides(x))
        for H, value in zip(self.curve, V):
            H.copy_((phi * value) @ phi.T / value.sum().clamp_min(1e-30))


def _moments(value: torch.Tensor) -> torch.Tensor:
    """Sums of rows and of their squares."""
    return torch.stack([value.sum(dim=1), (value * value).sum(dim=1)])
