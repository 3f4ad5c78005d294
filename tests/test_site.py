"""The documentation site: every page is opened, and holds no missing picture, no dead link and no unknown tag."""

from __future__ import annotations

import functools
import gzip
import json
import re
import subprocess
import sys
import threading
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml

import halfspace_sss
from tests.browser import chromium

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
ELSEWHERE = re.compile(r"^(https?:|data:|#|mailto:|javascript:)")
TAGS = set(
    "a abbr b blockquote body br button code dd del details div dl dt em figcaption figure footer form h1 h2 h3 h4"
    " h5 h6 head header hr html i iframe img input kbd label li link main meta nav noscript ol p path pre script"
    " section small span strong style sub summary sup svg table tbody td th thead title tr ul".split()
)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return folder


class Page(HTMLParser):
    """Tags, and what is linked to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: set[str] = set()
        self.links: set[str] = set()
        self.pictures = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.add(tag)
        self.pictures += tag == "img"
        self.links |= {value for key, value in attrs if key in ("href", "src") and value}


def _target(site: Path, page: Path, link: str) -> Path:
    path = unquote(re.split("[#?]", link)[0])
    found = site / path[1:] if path.startswith("/") else page.parent / path
    return found / "index.html" if found.is_dir() else found


@pytest.mark.slow
def test_every_page_has_its_pictures_and_links_and_known_tags_only(site: Path) -> None:
    wrong, pictures = [], 0
    for file in sorted(site.rglob("*.html")):
        page = Page(file.read_text(encoding="utf-8"))
        name, pictures = file.relative_to(site), pictures + page.pictures
        if file.parent.name != "flip":  # pages of figures
            wrong += [f"{name}: tag {tag}" for tag in page.tags - TAGS]
        near = [link for link in page.links if not ELSEWHERE.match(link)]
        wrong += [f"{name}: link {link}" for link in near if not _target(site, file, link).exists()]
    assert not wrong
    assert pictures >= 5


@pytest.mark.slow
def test_every_page_says_the_version_and_so_does_the_citation(site: Path) -> None:
    said = f"halfspace-sss {halfspace_sss.__version__}, "
    assert [file for file in site.rglob("index.html") if said not in file.read_text(encoding="utf-8")] == []
    assert f"version: {halfspace_sss.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_recipe_of_conda_asks_for_the_versions_of_the_package() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    recipe = yaml.safe_load((ROOT / "conda" / "recipe" / "recipe.yaml").read_text(encoding="utf-8"))
    wanted = {each.split(";")[0].strip() for each in project["dependencies"]}
    wanted = {each for each in wanted if not each.startswith("karellen")} | {f"python{project['requires-python']}"}
    assert {each.replace(" ", "") for each in recipe["requirements"]["run"]} == wanted
    found = [each.replace(" ", "") for each in recipe["requirements"]["run_constraints"]]
    assert found == project["optional-dependencies"]["render"]
    assert (recipe["package"]["version"], recipe["about"]["license"]) == (project["version"], project["license"])


@pytest.mark.slow
def test_notebooks_install_the_library_and_hold_the_cells_of_their_scripts(site: Path) -> None:
    scripts = sorted((ROOT / "docs" / "notebooks").glob("*.py"))
    for script in scripts:
        cells = json.loads((site / "notebooks" / f"{script.stem}.ipynb").read_text(encoding="utf-8"))["cells"]
        assert cells[0]["source"].startswith('%pip install "halfspace-sss[')
        code = [cell["source"] for cell in cells[1:] if cell["cell_type"] == "code"]
        assert all(each in script.read_text(encoding="utf-8") for each in code)
        assert "import halfspace_sss" in "".join(code)
    assert len(scripts) == 3


SEEN = """
const done = arguments[0], images = [...document.images];
const loaded = performance.getEntriesByType("resource").map(e => e.name);
images.forEach(image => image.loading = "eager");
Promise.all(images.map(image => image.decode().then(() => null, () => image.src))).then(broken =>
    done([loaded, broken.filter(src => src), document.documentElement.scrollWidth]));
"""
SEARCH = """
const query = document.getElementById("mkdocs-search-query");
query.value = "ketchup";
query.dispatchEvent(new Event("keyup"));
return document.querySelector("#mkdocs-search-results article") !== null;
"""
MOST = 1_000_000  # bytes before anybody scrolls, text as compressed as GitHub Pages sends it


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


def _size(file: Path) -> int:
    text = file.suffix in (".html", ".css", ".js", ".json", ".svg")
    return len(gzip.compress(file.read_bytes(), 6)) if text else file.stat().st_size


def _resize(driver: Any, width: int) -> None:
    metrics = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


@pytest.mark.slow
def test_pages_load_at_once_and_fit_a_phone_and_a_screen(site: Path) -> None:
    wait = pytest.importorskip("selenium.webdriver.support.wait").WebDriverWait
    pages = sorted(site.rglob("*.html"))
    handler = functools.partial(_Quiet, directory=str(site))
    size = functools.cache(_size)
    search = sum(size(file) for file in (site / "search").iterdir())  # a worker loads them, but in `flip/`
    wrong = []
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server, chromium() as driver:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        home = f"http://127.0.0.1:{server.server_port}/"
        driver.get(home)
        wait(driver, 30).until(lambda _: driver.execute_script(SEARCH))
        driver.execute_cdp_cmd(
            "Page.addScriptToEvaluateOnNewDocument", {"source": "Worker = class { postMessage() {} }"}
        )
        media = {"features": [{"name": "prefers-color-scheme", "value": "dark"}]}
        driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        for page in pages:
            name = page.relative_to(site)
            _resize(driver, 390)
            driver.get(home + name.as_posix())
            loaded, broken, *wide = driver.execute_async_script(SEEN)
            _resize(driver, 1280)
            wide.append(driver.execute_script("return document.documentElement.scrollWidth"))
            near = {site / unquote(urlsplit(url).path[1:]) for url in loaded if url.startswith(home)}
            total = size(page) + search * (page.parent.name != "flip") + sum(map(size, near))
            wrong += [f"{name}: broken {src}" for src in broken]
            wrong += [f"{name}: from elsewhere {url}" for url in loaded if not url.startswith(home)]
            wrong += [f"{name}: {wide} wide"] * (wide[0] > 390 or wide[1] > 1280)
            wrong += [f"{name}: {total} bytes"] * (total > MOST)
        assert driver.execute_script("return document.documentElement.dataset.bsTheme") == "dark"
        server.shutdown()
    assert len(pages) > 36
    assert wrong == []
