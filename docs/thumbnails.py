"""Hooks of MkDocs: pages show small pictures, which load when they come near, and code has colours in both modes."""

from __future__ import annotations

import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from PIL import Image
from pygments.formatters import HtmlFormatter

WIDTH = 1000  # pixels, more than the column of a page has
PICTURE = re.compile(r'src="(?P<up>(?:\.\./)*)(?P<name>[\w-]+)\.png"')
STYLES = {"": "default", "[data-bs-theme=dark] ": "monokai"}


def on_page_content(html: str, config: MkDocsConfig, **_: object) -> str:
    """The HTML of a page with its small pictures."""

    def small(found: re.Match[str]) -> str:
        with Image.open(Path(config.docs_dir) / f"{found['name']}.png") as image:
            width, height = image.size
        size = f'width="{min(width, WIDTH)}" height="{round(height * min(1, WIDTH / width))}"'
        return f'src="{found["up"]}small/{found["name"]}.webp" {size} loading="lazy"'

    return PICTURE.sub(small, html)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the small pictures and the colours of code."""
    site = Path(config.site_dir)
    (site / "small").mkdir(exist_ok=True)
    for file in sorted(Path(config.docs_dir).glob("*.png")):
        with Image.open(file) as image:
            image.thumbnail((WIDTH, 10 * WIDTH))
            image.convert("RGBA").save(site / "small" / f"{file.stem}.webp", quality=80)
    rules = [HtmlFormatter(style=style).get_style_defs(f"{mode}.codehilite") for mode, style in STYLES.items()]
    (site / "code.css").write_text("\n".join(rules), encoding="utf-8")
