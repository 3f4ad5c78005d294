"""Ctrl-C in `mitsuba.render`: heard within about a second, with Python's handler in place afterwards."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

from full_geometry.integrators import bssrdf as integrator

mi = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX signals")

CODE = """
import os, signal, sys, threading, time
from tests.rendering.test_render_interrupts import scene_of
import mitsuba as mi
scene = scene_of(sys.argv[1], 128)
mi.render(scene, spp=1)
sent = []
def send(wait):
    time.sleep(wait)
    sent.append(time.monotonic())
    os.kill(os.getpid(), signal.SIGINT)
for wait in (0.1, 0.8):
    threading.Thread(target=send, args=(wait,), daemon=True).start()
    try:
        mi.render(scene, spp=2**13).numpy()
    except KeyboardInterrupt:
        print("heard after", time.monotonic() - sent[-1])
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)
    except KeyboardInterrupt:
        print("heard again")
print(sys.getprofile(), mi.render(scene, spp=1).numpy().mean() > 0)
"""


def scene_of(kind: str, size: int, sampler: str = "independent"):
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    camera = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "gaussian"}}
    medium = {"albedo": 0.9, "sigma_t": 2.0, "g": 0.3, "eta": 1.4}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": kind, "mm_per_unit": 10.0},
            "sensor": {"type": "perspective", "to_world": camera, "film": film, "sampler": {"type": sampler}},
            "object": {"type": "sphere", "bsdf": {"type": "translucent", "model": "better_dipole", **medium}},
            "light": {"type": "constant"},
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_an_interrupt_is_heard_early_and_late_in_a_launch_and_so_is_the_next_one(integrator: str) -> None:
    for _ in range(2):  # once more where other tests held the cores
        run = [sys.executable, "-c", CODE, integrator]
        done = subprocess.run(run, capture_output=True, text=True, timeout=240, cwd=os.getcwd())
        assert done.returncode == 0, done.stderr
        lines = [line for line in done.stdout.splitlines() if "WARN" not in line]
        heard = [float(line.split()[-1]) for line in lines if "heard after" in line]
        assert len(heard) == 2
        assert sum("heard again" in line for line in lines) == 2 and any("None True" in line for line in lines)
        if max(heard) < 3:  # 0.4 s alone on two cores
            return
    pytest.fail(f"interrupts must be heard within 3 s, got {heard}")


def test_images_in_many_launches_are_those_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of("bssrdf", 16)
    whole = mi.render(scene, spp=24, seed=5).numpy()
    monkeypatch.setattr(integrator, "SAMPLES_PER_LAUNCH", 16**2 * 10)
    np.testing.assert_allclose(mi.render(scene, spp=24, seed=5).numpy(), whole, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["independent", "stratified", "multijitter", "orthogonal", "ldsampler"])
def test_only_independent_samples_are_split_into_launches(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Others keep their stratification, and the number of samples that they round up once."""
    sensor = scene_of("bssrdf", 16, kind).sensors()[0]
    monkeypatch.setattr(integrator, "SAMPLES_PER_LAUNCH", 16**2 * 32)
    first = next(integrator.launches(sensor, 128))
    assert first == (0, 32 if kind == "independent" else 128)


def test_stratified_samples_make_the_image_of_one_launch(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = scene_of("bssrdf", 16, "stratified")
    whole = mi.render(scene, spp=64, seed=1).numpy()
    monkeypatch.setattr(integrator, "SAMPLES_PER_LAUNCH", 16**2 * 16)
    # sums into pixels are atomic, so their order, and the last bits, may differ
    np.testing.assert_allclose(mi.render(scene, spp=64, seed=1).numpy(), whole, rtol=1e-4, atol=1e-6)


def test_a_render_in_another_thread_leaves_signals_alone() -> None:
    scene, found = scene_of("bssrdf", 8), []
    thread = threading.Thread(target=lambda: found.append(mi.render(scene, spp=4).numpy()))
    thread.start()
    thread.join()
    assert found[0].mean() > 0
