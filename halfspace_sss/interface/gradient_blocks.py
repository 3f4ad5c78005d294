"""Derivatives by torch in blocks of queries, so that their memory is bounded."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING

from halfspace_sss.arrays import Library, Real, is_torch
from halfspace_sss.lazy import once

if TYPE_CHECKING:
    import torch
    from torch.autograd.function import FunctionCtx

BLOCK_BYTES = 1 << 27  # that torch keeps of one block
PROBE = 64  # queries


def recorded_in_blocks(lib: Library, f: Callable[..., Real], args: tuple) -> Real:
    """f(*args), a function of each query alone, so that torch keeps the arguments for its derivatives and no more.

    torch keeps what every operation was given, tens of kB a query where a model integrates. Queries that would exceed
    `BLOCK_BYTES` are therefore split, and each block is recorded when it is gone through backwards. Other libraries,
    and what is not differentiated or depends on further tensors that are, are answered at once.
    """
    if not _recorded(lib, args):
        return f(*args)
    torch, shape = lib.torch, args[0].shape
    flat = [a.reshape(-1) for a in args]
    if f(*(a[:1].detach() for a in flat)).requires_grad:
        return f(*args)
    size = max(PROBE, int(BLOCK_BYTES / max(_kept_bytes(torch, f, flat), 1.0)))
    if len(flat[0]) <= size:
        return f(*args)
    blocks = zip(*(a.split(size) for a in flat))
    values = torch.cat([_block_class().apply(f, *block) for block in blocks])
    return values.reshape(*shape, *values.shape[1:])


def _recorded(lib: Library, args: tuple) -> bool:
    """Whether torch records derivatives for going backwards, and of more queries than the probes take."""
    if not is_torch(lib) or not lib.torch.is_grad_enabled() or args[0].numel() <= 2 * PROBE:
        return False
    forward = lib.torch.autograd.forward_ad.unpack_dual
    if lib.torch._C._are_functorch_transforms_active() or any(forward(a).tangent is not None for a in args):
        return False
    return any(a.requires_grad for a in args)


def _kept_bytes(torch: ModuleType, f: Callable[..., Real], flat: list) -> float:
    """What the graph of f keeps of one query: by how much that of two probes differs from that of one."""
    sizes = []
    for n in (PROBE, 2 * PROBE):
        kept: dict[int, int] = {}

        def keep(tensor: torch.Tensor, kept: dict = kept) -> torch.Tensor:
            storage = tensor.untyped_storage()
            kept[storage.data_ptr()] = storage.nbytes()
            return tensor

        probe = [a[:n].clone().detach().requires_grad_(a.requires_grad) for a in flat]
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            graph = f(*probe)
        sizes.append(sum(kept.values()))
        del graph
    return (sizes[1] - sizes[0]) / PROBE


@once
def _block_class() -> type:
    import torch

    class Block(torch.autograd.Function):
        """f(*args), recorded when its derivatives are asked for; those of higher order are recorded whole."""

        @staticmethod
        def forward(ctx: FunctionCtx, f: Callable[..., Real], *args: torch.Tensor) -> torch.Tensor:
            ctx.f = f
            ctx.save_for_backward(*args)
            return f(*args)

        @staticmethod
        def backward(ctx: FunctionCtx, outer: torch.Tensor) -> tuple:
            again, needed = torch.is_grad_enabled(), ctx.needs_input_grad[1:]
            args = [a if again else a.detach().requires_grad_(n) for a, n in zip(ctx.saved_tensors, needed)]
            inputs = [a for a, n in zip(args, needed) if n]
            with torch.enable_grad():
                value = ctx.f(*args)
                result = torch.autograd.grad(value, inputs, outer, create_graph=again, allow_unused=True)
            grads = iter(result)
            return None, *(next(grads) if n else None for n in needed)

    return Block
