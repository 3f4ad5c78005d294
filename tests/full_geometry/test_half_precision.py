"""What networks cost in half precision, as they are evaluated on CUDA; tried on LLVM, which has it too."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")

from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.transport.any_shape import transport  # noqa: E402
from halfspace_sss.neural import perceptron  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

MARBLE = Medium([2.19, 2.62, 3.0], [0.0021, 0.0041, 0.0071], 0.0, 1.5)
N = 2**15
SINGLE = perceptron.cooperative


def in_half(x: Any) -> Any:
    """As on CUDA."""
    kind = dr.expr_t(*x)
    return SINGLE([dr.float16_array_t(kind)(dr.clip(v, -256, 256)) for v in x])


@pytest.mark.slow
def test_the_network_of_all_shapes_is_off_by_less_than_its_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both S_0 and the correction are networks: 0.1 % in the median, 1 % nearly everywhere, none in the mean."""
    mi.set_variant("llvm_ad_rgb")
    obj = object_of(mi.load_dict({"type": "sphere", "radius": 3.0}), MARBLE)
    model, rng = transport(obj), generator(mi, N, pass_seed(4))
    exit, entry = obj.random_points(rng), obj.random_points(rng)
    dr.eval(exit, entry)
    single = np.array(model.S(model.prepare(exit), entry), dtype=float)
    monkeypatch.setattr(perceptron, "cooperative", in_half)
    half = np.array(model.S(model.prepare(exit), entry), dtype=float)
    off = np.abs(half / single - 1)
    assert np.isfinite(half).all() and half.min() > 0
    assert np.all(np.median(off, axis=1) < 3e-3) and np.all(np.quantile(off, 0.99, axis=1) < 1.5e-2)
    assert np.all(np.abs(half.mean(axis=1) / single.mean(axis=1) - 1) < 2e-3)
    assert off.max() > 0  # it was in half
