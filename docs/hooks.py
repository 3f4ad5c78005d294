"""Hooks of MkDocs: small pictures, which load when they come near, colours of code in both modes, images of the pages
in `flip/` as files, which load when they are shown, and a notebook beside each script with cells, whose first cell
installs what it needs, as Colab wants it.
"""

from __future__ import annotations

import base64
import json
import re
from itertools import count
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from PIL import Image
from pygments.formatters import HtmlFormatter

WIDTH = 1000  # pixels, more than the column of a page has
PICTURE = re.compile(r'src="(?P<up>(?:\.\./)*)(?P<name>[\w-]+)\.png"')
EMBEDDED = re.compile(r'"data:image/(\w+);base64,([^"]+)"')
CELL = re.compile(r"^# %%(?: \[(markdown)\])?\n", re.MULTILINE)
INSTALL = re.compile(r"pip install \"[^\"]+\"")
STYLES = {"": "default", "[data-bs-theme=dark] ": "monokai"}


def notebook(script: str) -> str:
    """The notebook of a script with cells, after one that installs what the script says that it needs."""
    _, *parts = CELL.split(script)
    cells = [("code", f"%{INSTALL.search(script)[0]}")]
    for kind, text in zip(parts[::2], parts[1::2]):
        plain = re.sub(r"^# ?", "", text, flags=re.MULTILINE) if kind else text
        cells.append((kind or "code", plain.strip()))
    code = {"execution_count": None, "outputs": []}
    made = [
        {"cell_type": kind, "id": f"c{k}", "metadata": {}, "source": text, **(code if kind == "code" else {})}
        for k, (kind, text) in enumerate(cells)
    ]
    about = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    return json.dumps({"nbformat": 4, "nbformat_minor": 5, "metadata": about, "cells": made}, indent=1)


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add the notebook of each script."""
    for file in Path(config.docs_dir).glob("notebooks/*.py"):
        made = notebook(file.read_text(encoding="utf-8"))
        files.append(File.generated(config, f"notebooks/{file.stem}.ipynb", content=made))


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to scripts with cells are links to their notebooks too, which the repository does not hold."""
    return re.sub(r"\[(\w+)\.py\]\((notebooks/\w+)\.py\)", r"[\1.ipynb](\2.ipynb), [.py](\2.py)", markdown)


def on_page_content(html: str, config: MkDocsConfig, **_: object) -> str:
    """The HTML of a page with its small pictures."""

    def small(found: re.Match[str]) -> str:
        with Image.open(Path(config.docs_dir) / f"{found['name']}.png") as image:
            width, height = image.size
        size = f'width="{min(width, WIDTH)}" height="{round(height * min(1, WIDTH / width))}"'
        return f'src="{found["up"]}small/{found["name"]}.webp" {size} loading="lazy"'

    return PICTURE.sub(small, html)


def on_post_build(config: MkDocsConfig) -> None:
    """Write the small pictures, the images of pages in `flip/` and the colours of code."""
    site = Path(config.site_dir)
    (site / "small").mkdir(exist_ok=True)
    for file in sorted(Path(config.docs_dir).glob("*.png")):
        with Image.open(file) as image:
            image.thumbnail((WIDTH, 10 * WIDTH))
            image.convert("RGBA").save(site / "small" / f"{file.stem}.webp", quality=80)
    for page in (site / "flip").glob("*.html"):
        page.write_text(_apart(page.read_text(encoding="utf-8"), page.with_suffix("")), encoding="utf-8")
    rules = [HtmlFormatter(style=style).get_style_defs(f"{mode}.codehilite") for mode, style in STYLES.items()]
    (site / "code.css").write_text("\n".join(rules), encoding="utf-8")


def _apart(html: str, folder: Path) -> str:
    """A page whose embedded images are files of a folder beside it."""
    folder.mkdir()
    numbers = count()

    def written(found: re.Match[str]) -> str:
        file = folder / f"{next(numbers)}.{found[1]}"
        file.write_bytes(base64.b64decode(found[2]))
        return f'"{folder.name}/{file.name}"'

    return EMBEDDED.sub(written, html)
