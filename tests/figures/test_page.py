"""The page that flips between images, in a real browser: what is visible, and that all panels move in step."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import chromium as browser_of_tests
from PIL import Image

from figures.computing.images import Shot, absent, compared
from figures.drawing.page import page
from full_geometry.trade.image_differences import srgb

REFERENCE, DARK, BRIGHT = 0.25, 0.1, 0.6
ARROWS = {"left": "\ue012", "up": "\ue013", "right": "\ue014", "down": "\ue015"}


def _scenes() -> dict[str, list[Shot]]:
    """Two scenes of 16 x 24 pixels, each image in a tone of its own, with one bright pixel."""
    scenes = {}
    for name, scale in (("marble", 1.0), ("<ketchup> & co", 0.5)):
        reference = np.full((16, 24, 3), REFERENCE * scale, dtype=np.float32)
        reference[4, 18] = 1.0
        shots = [Shot("path traced", reference, {"time, s": 60.0})]
        for label, level, seconds in (("dark", DARK, 1.25), ("bright", BRIGHT, 0.5)):
            image = np.full_like(reference, level * scale)
            shots.append(compared(label, image, reference, numbers={"time, s": seconds}))
        scenes[name] = [*shots, absent("full geometry", "not yet there")]
    return scenes


@pytest.fixture(scope="module")
def text() -> str:
    return page("Models </script> & all", _scenes(), caption="a caption", notes="what FLIP is")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    with browser_of_tests() as driver:
        yield driver


@pytest.fixture
def browser(chromium: Any, text: str, tmp_path: Path) -> Any:
    """The page, freshly opened in a window of 1200 x 800."""
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    chromium.set_window_size(1200, 800)
    chromium.get((tmp_path / "page.html").as_uri())
    return chromium


def _press(browser: Any, *keys: str) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    ActionChains(browser).send_keys(*keys).perform()


def _find(browser: Any, selector: str) -> list[Any]:
    return browser.find_elements("css selector", selector)


def _shown(browser: Any) -> list[str]:
    """Captions of the panels, each of which shows one image at most."""
    assert all(len(view.find_elements("css selector", "img.on")) <= 1 for view in _find(browser, ".view"))
    return [caption.text for caption in _find(browser, ".panel figcaption b")]


def _transforms(browser: Any) -> list[str]:
    return [sheet.get_attribute("style").split("transform:")[1] for sheet in _find(browser, ".sheet")]


def _pixels(browser: Any, panel: int = 0) -> np.ndarray:
    """What a panel shows on the screen."""
    png = _find(browser, ".view")[panel].screenshot_as_png
    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def _middle(browser: Any, panel: int = 0) -> float:
    """The colour somewhat left of the middle, where every image has its tone."""
    pixels = _pixels(browser, panel)
    return pixels[pixels.shape[0] // 2, pixels.shape[1] // 4].mean()


def _tone(level: float) -> Any:
    return pytest.approx(255 * float(srgb(np.array(level))), abs=1.1)


def test_it_needs_nothing_from_outside(browser: Any, text: str) -> None:
    assert (
        not re.search(r"(src|href)=\"(?!data:)", text) and "@import" not in text and "//" not in text.split("<svg")[0]
    )
    loaded = browser.execute_script("return performance.getEntriesByType('resource').map(e => e.name)")
    assert all(name.startswith("data:") for name in loaded)
    assert not browser.get_log("browser")


def test_keys_flip_between_images(browser: Any) -> None:
    assert _shown(browser)[0] == "dark"
    for key, label, level in (("1", "path traced", REFERENCE), ("3", "bright", BRIGHT), ("2", "dark", DARK)):
        _press(browser, key)
        assert _shown(browser)[0] == label
        assert _middle(browser) == _tone(level)
        assert [row.text.split()[1] for row in _find(browser, "tr.on")] == [label.split()[0]]


def test_arrows_go_through_images_and_scenes_and_leave_out_what_is_not_there(browser: Any) -> None:
    labels = []
    for _ in range(3):
        _press(browser, ARROWS["right"])
        labels.append(_shown(browser)[0])
    assert labels == ["bright", "path traced", "dark"]
    _press(browser, "3", ARROWS["down"])
    assert _find(browser, "[role=tab][aria-selected=true]")[0].text == "<ketchup> & co"
    assert _shown(browser)[0] == "bright" and _middle(browser) == _tone(BRIGHT / 2)


def test_space_goes_back_to_the_image_before(browser: Any) -> None:
    _press(browser, "3", "2", " ")
    assert _shown(browser)[0] == "bright"
    _press(browser, " ")
    assert _shown(browser)[0] == "dark"


def test_names_and_tabs_can_be_clicked(browser: Any) -> None:
    _find(browser, "#values tbody button")[2].click()
    _find(browser, "[role=tab]")[1].click()
    assert _shown(browser)[0] == "bright" and _middle(browser) == _tone(BRIGHT / 2)
    assert not _find(browser, "#values tbody button")[3].is_enabled()


def test_all_panels_zoom_and_move_in_step(browser: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    seen = [_transforms(browser)]
    view = _find(browser, ".view")[1]
    ActionChains(browser).scroll_from_origin(ScrollOrigin.from_element(view, 60, 40), 0, -600).perform()
    seen.append(_transforms(browser))
    ActionChains(browser).click_and_hold(_find(browser, ".view")[0]).move_by_offset(40, 30).release().perform()
    seen.append(_transforms(browser))
    _press(browser, "+", ARROWS["right"])
    seen.append(_transforms(browser))
    assert all(len(transforms) == 2 and len(set(transforms)) == 1 for transforms in seen)
    assert len({transforms[0] for transforms in seen}) == 4
    _press(browser, "0")
    assert _transforms(browser) == seen[0]


def test_the_pixel_under_the_pointer_stays_there_while_zooming(browser: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin

    _press(browser, "1")
    pixels = _pixels(browser)
    y, x = (int(k) for k in np.argwhere(pixels.min(axis=2) > 250).mean(axis=0))
    view = _find(browser, ".view")[0]
    offset = (x - pixels.shape[1] // 2, y - pixels.shape[0] // 2)
    ActionChains(browser).scroll_from_origin(ScrollOrigin.from_element(view, *offset), 0, -900).perform()
    zoomed = _pixels(browser)
    assert zoomed[y, x].min() > 250 and (zoomed.min(axis=2) > 250).sum() > 4 * (pixels.min(axis=2) > 250).sum()


def test_pixels_are_enlarged_without_smoothing(browser: Any) -> None:
    _press(browser, "1", *"++")
    inside = _pixels(browser)[20:-20, 20:-20].reshape(-1, 3)
    assert set(np.unique(inside)) == {255, round(255 * float(srgb(np.array(REFERENCE))))}


def test_maps_stand_beside_the_image_and_can_be_put_away(browser: Any) -> None:
    _press(browser, "3")
    assert _shown(browser) == ["bright", "FLIP, bright"]
    _press(browser, "d")
    assert _shown(browser)[1] == "relative difference, bright"
    red, _, blue = _pixels(browser, 1)[_pixels(browser, 1).shape[0] // 2, 50]
    assert red > blue  # brighter than the reference
    _press(browser, "r")
    assert _shown(browser)[1] == "path traced" and _middle(browser, 1) == _tone(REFERENCE)
    _press(browser, "r")
    assert _shown(browser) == ["bright"]


def test_all_images_are_shown_at_once_in_step(browser: Any) -> None:
    _press(browser, "r", "a", "+")
    assert _shown(browser) == ["path traced", "dark", "bright"]
    assert len(set(_transforms(browser))) == 1
    _press(browser, "f")
    assert [len(view.find_elements("css selector", "img.on[data-name=flip]")) for view in _find(browser, ".view")] == [
        0,
        1,
        1,
    ]


def test_exposure_scales_light_and_leaves_maps_as_they_are(browser: Any) -> None:
    _press(browser, "2")
    before = _middle(browser, 1)
    _press(browser, *"]]")
    assert _find(browser, "#stops")[0].text == "+1"
    assert _middle(browser) == pytest.approx(255 * float(srgb(np.array(2 * DARK))), abs=3)
    assert _middle(browser, 1) == before


def test_the_table_has_the_numbers_and_marks_the_smallest(browser: Any) -> None:
    shots = _scenes()["marble"]
    assert [cell.text for cell in _find(browser, "#values th")] == ["image", "FLIP", "relMSE", "time, s"]
    for shot in shots[1:3]:
        assert f"{shot.numbers['FLIP']:.3g}" in _find(browser, "#values")[0].text
    best = min(shot.numbers["FLIP"] for shot in shots[1:3])
    assert _find(browser, "td.best")[0].text == f"{best:.3g}"
    assert "not yet there" in _find(browser, "tr.absent")[0].text


def test_it_can_be_used_in_a_small_window(browser: Any) -> None:
    browser.set_window_size(500, 700)
    _press(browser, "3", "+")
    assert browser.execute_script("return document.documentElement.scrollWidth <= innerWidth")
    assert all(view.size["width"] > 200 and view.size["height"] > 100 for view in _find(browser, ".view"))
    assert len(set(_transforms(browser))) == 1


def test_an_address_leads_to_an_image(browser: Any) -> None:
    _press(browser, ARROWS["down"], "3")
    address = browser.current_url
    browser.get("about:blank")
    browser.get(address)
    assert _shown(browser)[0] == "bright" and _middle(browser) == _tone(BRIGHT / 2)


_GOOD = Shot("a", np.zeros((4, 4, 3)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: page("t", {}), "scenes must hold at least one scene"),
        (lambda: page("t", {"s": [absent("a")]}), "scene 's' must start with the image of its reference"),
        (lambda: page("t", {"s": [_GOOD, _GOOD]}), "labels of scene 's' must differ"),
        (lambda: page("t", {"s": [_GOOD, Shot("b", np.zeros((4, 5, 3)))]}), r"image of 'b' in 's' must have the size"),
        (lambda: Shot("b", np.full((4, 4, 3), np.nan)), "image 'b' must be finite"),
    ],
)
def test_bad_input_is_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.slow
def test_the_same_images_give_the_same_page(text: str) -> None:
    assert page("Models </script> & all", _scenes(), caption="a caption", notes="what FLIP is") == text
