"""A scene that is looked at while it is changed: its images are those of the scene that it saves."""

from __future__ import annotations

import itertools
import os
import re
import signal
import subprocess
import sys
import time
from http import HTTPStatus
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import psutil
import pytest
from browser import chromium

from full_geometry.surface.translucent import check_eta, is_rough
from full_geometry.viewing.edits import Camera, Edits, Way
from full_geometry.viewing.live import LiveScene, Screen, Shown, Wish
from full_geometry.viewing.page import check_port, free_port, refusal

SCENE = """<scene version="3.0.0">
    <integrator type="bssrdf"> <string name="light" value="sampled"/> </integrator>
    <sensor type="perspective">
        <float name="fov" value="40"/>
        <transform name="to_world"> <lookat origin="0, -4, 1" target="0, 0, 0" up="0, 0, 1"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="8"/> <integer name="height" value="8"/> </film>
        <sampler type="independent"/>
    </sensor>
    <shape type="sphere" id="ball">
        <bsdf type="translucent">
            <rgb name="sigma_s" value="3, 2, 1"/> <rgb name="sigma_a" value="0.1, 0.2, 0.3"/>
            <string name="model" value="lambert"/>
        </bsdf>
    </shape>
    <emitter type="point"> <point name="position" x="3" y="-3" z="3"/> <float name="intensity" value="9"/> </emitter>
    <emitter type="envmap"> <string name="filename" value="day.exr"/> </emitter>
</scene>
"""
OWN = {"reflectance": (0.6, 0.5, 0.4), "mfp": (0.5, 0.4, 0.3), "g": 0.2, "eta": 1.3}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    for name, level in (("day", 0.5), ("maps/dusk", 0.1)):
        pixels = np.full((4, 8, 3), level, np.float32)
        pixels[1, 2] = 5
        (folder / name).parent.mkdir(exist_ok=True)
        mi.Bitmap(pixels).write(str(folder / f"{name}.exr"))
    (folder / "ball.xml").write_text(SCENE)
    return folder / "ball.xml"


@pytest.fixture(scope="module")
def live(file: Path) -> LiveScene:
    return LiveScene(file)


def _last(live: LiveScene, camera: Camera, way: Way) -> Shown:
    return list(itertools.islice(live.passes(camera, way), 3))[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edits", "kept"),
    [
        (Edits(turn=40, tilt=20, stops=1), True),
        (Edits(turn=-60, environment="maps/dusk.exr"), True),
        (Edits(media={"ball": OWN}), True),
        (Edits(media={"ball": {**OWN, "eta": 1.5}}), False),
    ],
    ids=["light", "environment", "medium", "index"],
)
@pytest.mark.parametrize("walks", [False, True], ids=["model", "walks"])
def test_images_are_those_of_the_scene_that_is_saved(live: LiveScene, edits: Edits, kept: bool, walks: bool) -> None:
    live.apply(Edits())
    before, camera, way = live.scene, live.camera(64), Way("path_traced", "precomputed") if walks else live.way
    plain = _last(live, camera, way)
    live.apply(edits)
    assert (live.scene is before) == kept
    found = _last(live, camera, way)
    assert live.save("saved.xml", way, camera, edits).startswith("halfspace-sss render")
    fresh = LiveScene(live.folder / "saved.xml")
    assert fresh.way == way
    wanted = _last(fresh, fresh.camera(64), fresh.way)
    np.testing.assert_allclose(found.image, wanted.image, rtol=1e-3, atol=1e-4)
    assert np.abs(found.image - plain.image).mean() > 1e-2
    assert found.spp == 2 and 0 < found.error < 1


@pytest.mark.slow
def test_walks_keep_the_light_inside_while_the_camera_moves(live: LiveScene, monkeypatch: pytest.MonkeyPatch) -> None:
    from full_geometry.integrators import translucent_walk

    way, filled, find = Way("path_traced", "precomputed"), [], translucent_walk.unscattered_light

    def counted(*args: Any) -> object:
        filled.append(args[5])
        return find(*args)

    monkeypatch.setattr(translucent_walk, "unscattered_light", counted)
    live.apply(Edits())
    camera = live.camera(64)
    shown = [each for each in itertools.islice(live.passes(camera, way), 6)][-1]
    assert filled == [translucent_walk.PREVIEW_RAYS, translucent_walk.FEWEST_RAYS] and shown.spp == 5
    list(itertools.islice(live.passes(camera._replace(fov=50.0), way), 3))
    assert len(filled) == 2
    live.apply(Edits(turn=40))
    _last(live, camera, way)
    assert filled[2:] == [translucent_walk.PREVIEW_RAYS]


@pytest.mark.slow
def test_a_denoised_look_is_smoother_than_the_noisy_one_where_surfaces_are(live: LiveScene) -> None:
    pytest.importorskip("mitsuba_oidn")
    live.apply(Edits())
    camera, rough = live.camera(64), []
    for denoise in (False, True):
        image = _last(live, camera, Way("path_traced", "precomputed", denoise)).image
        middle = image[tuple(slice(n // 3, 2 * n // 3) for n in image.shape[:2])]
        rough.append(np.abs(np.diff(middle, axis=1)).mean())
    assert 0 < rough[1] < 0.7 * rough[0]


@pytest.mark.parametrize("medium", [{}, OWN, {"material": "ketchup"}], ids=["own", "numbers", "material"])
def test_a_rough_boundary_has_the_index_of_its_medium(live: LiveScene, medium: dict[str, Any]) -> None:
    live.apply(Edits(media={"ball": {**medium, "roughness": 0.2}}))
    live.save("rough.xml", live.way, live.camera(64), live.edits)
    for each in (live, LiveScene(live.folder / "rough.xml")):
        boundary = each.scene.shapes()[0].bsdf().boundary
        assert is_rough(boundary) and float(mi.traverse(boundary)["alpha.value"][0]) == pytest.approx(0.2)
        check_eta(boundary, each.medium(each.names[0]).eta)


def test_a_screen_shows_passes_begins_anew_and_ends_early(live: LiveScene) -> None:
    screen, wish = Screen(), Wish(Edits(), live.way, live.camera(64))
    coarse = screen.step(live, wish, lambda: False)
    assert coarse[0].shape == (8, 8, 3) and coarse[0].dtype == np.uint8 and "coarse" in coarse[1]
    assert "1 samples" in screen.step(live, wish, lambda: False)[1]
    brighter = screen.step(live, wish._replace(exposure=1.0), lambda: False)
    assert brighter[0].mean() > coarse[0].mean() and "2 samples" in brighter[1]
    edited = wish._replace(edits=Edits(stops=1.0))
    assert screen.step(live, edited, lambda: True) is None
    assert "coarse" in screen.step(live, edited, lambda: False)[1]


def test_a_screen_says_why_a_scene_is_refused_and_goes_on(live: LiveScene) -> None:
    screen, wish = Screen(), Wish(Edits(), live.way, live.camera(64))
    refused = wish._replace(edits=Edits(environment="../day.exr"))
    picture, told = screen.step(live, refused, lambda: False)
    assert picture is None and "environment must be a map in the folder" in told
    assert screen.step(live, refused, lambda: False) is None
    assert screen.step(live, wish, lambda: False)[0] is not None


@pytest.mark.parametrize("asked", ["../out.xml", "ball.xml", "out.png"])
def test_only_new_scenes_beside_the_file_are_written(live: LiveScene, asked: str) -> None:
    with pytest.raises(ValueError, match="name must be of a new .xml file"):
        live.save(asked, live.way, live.camera(64), Edits())


def test_maps_are_those_of_the_folder(live: LiveScene, tmp_path: Path) -> None:
    (live.folder / "out.exr").symlink_to(tmp_path / "out.exr")
    (tmp_path / "out.exr").write_bytes(b"")
    assert live.environments() == ["day.exr", "maps/dusk.exr"]


@pytest.mark.parametrize(
    ("path", "headers", "token", "status"),
    [
        ("/", {"Host": "localhost:1"}, "", None),
        ("/", {"Host": "localhost:1", "Origin": "http://localhost:1"}, "", None),
        ("/", {"Host": "localhost:1", "Origin": "http://evil.org"}, "", HTTPStatus.FORBIDDEN),
        ("/", {"Host": "evil.org:1"}, "", HTTPStatus.FORBIDDEN),
        ("/", {"Host": "box:1"}, "secret", HTTPStatus.UNAUTHORIZED),
        ("/?token=wrong", {"Host": "box:1"}, "secret", HTTPStatus.UNAUTHORIZED),
        ("/?token=secret", {"Host": "box:1"}, "secret", HTTPStatus.FOUND),
        ("/", {"Host": "box:1", "Cookie": "name=secret"}, "secret", None),
        ("/", {"Host": "box:1", "Cookie": "name=wrong"}, "secret", HTTPStatus.UNAUTHORIZED),
    ],
)
def test_who_may_connect(path: str, headers: dict[str, str], token: str, status: HTTPStatus | None) -> None:
    assert refusal(path, headers, token, "name")[0] == status


def test_a_taken_port_is_refused() -> None:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ValueError, match=f"port must be free at 127.0.0.1, got {port}"):
            check_port("127.0.0.1", port)


def _run(file: Path, port: int) -> subprocess.Popen:
    start = [sys.executable, "-c", "from figures.command_line import main; main()"]
    command = [*start, "view", str(file), "--port", str(port), "--side", "64"]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _until(what: str, found: Any, seconds: float = 240.0) -> Any:
    end = time.monotonic() + seconds
    while not (result := found()):
        assert time.monotonic() < end, what
        time.sleep(0.2)
    return result


@pytest.mark.slow
def test_the_page_in_a_browser(file: Path) -> None:
    from selenium.webdriver.common.keys import Keys

    port = free_port("127.0.0.1")
    view = _run(file, port)
    try:
        while "Ctrl-C ends" not in (line := view.stdout.readline()):
            assert line or view.poll() is None, view.stderr.read()
        with chromium("--enable-unsafe-swiftshader", "--window-size=900,600") as browser:
            text = lambda: browser.execute_script("return document.body ? document.body.innerText : ''")  # noqa: E731
            browser.get(f"http://localhost:{port}/")
            _until("no picture", lambda: re.search(r"\d+ samples, noise", text()))
            before = browser.get_screenshot_as_png()

            # a slider by its keys
            slider = browser.find_elements("css selector", "[role=slider]")[4]
            slider.send_keys(Keys.HOME)
            _until("no coarse picture", lambda: "coarse" in text() or "samples" in text())
            _until("no change", lambda: _differ(before, browser.get_screenshot_as_png()))

            # another client, and the same port again
            browser.switch_to.new_window("tab")
            browser.get(f"http://localhost:{port}/")
            _until("no second picture", lambda: re.search(r"\d+ samples, noise", text()))
            other = _run(file, port)
            assert f"port must be free at 127.0.0.1, got {port}" in other.communicate(timeout=240)[1]
            assert other.returncode == 2
    finally:
        children = psutil.Process(view.pid).children(recursive=True)
        os.kill(view.pid, signal.SIGINT)
        _, told = view.communicate(timeout=60)
    assert view.returncode == 130 and "Traceback" not in told
    assert not [child for child in children if child.is_running()]


def _differ(a: bytes, b: bytes) -> bool:
    """Whether the left half of two pictures, beside the controls, differs."""
    import io

    from PIL import Image

    one, other = (np.asarray(Image.open(io.BytesIO(v)).convert("RGB"), dtype=float)[200:, :300] for v in (a, b))
    return bool(np.abs(one - other).mean() > 10)
