"""The variants of Mitsuba under which the plugins run."""

from __future__ import annotations

__all__ = ["VARIANTS", "variant_channels"]

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
