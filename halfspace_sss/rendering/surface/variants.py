"""The variants of Mitsuba under which the plugins run."""

from __future__ import annotations

from typing import Any

__all__ = ["VARIANTS", "channel_mean", "variant_channels"]

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb", "llvm_ad_mono", "cuda_ad_mono")


def variant_channels() -> int:
    """3 under an RGB variant of Mitsuba, 1 under a mono one.

    Raises:
        ValueError: no variant is set, or another kind is.
    """
    import mitsuba as mi

    variant = mi.variant()
    if variant not in VARIANTS:
        raise ValueError(f"variant must be llvm_ad_ or cuda_ad_ with rgb or mono, got {variant!r}")
    return 3 if variant.endswith("rgb") else 1


def channel_mean(value: Any) -> Any:
    """Mean over the channels of a colour.

    By `drjit.mean` the number of lanes is part of a kernel, which is then compiled anew for every size of an image.
    """
    import drjit as dr

    return dr.sum(value) / len(value)
