"""The documentation site: every page is opened, and holds no missing picture, no dead link and no unknown tag."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest

import halfspace_sss

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
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
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


def test_every_page_says_the_version_and_so_does_the_citation(site: Path) -> None:
    said = f"halfspace-sss {halfspace_sss.__version__}, "
    assert [file for file in site.rglob("index.html") if said not in file.read_text(encoding="utf-8")] == []
    assert f"version: {halfspace_sss.__version__}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_the_site_begins_with_a_page(site: Path) -> None:
    assert "halfspace-sss curves" in (site / "index.html").read_text(encoding="utf-8")
