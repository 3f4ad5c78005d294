"""Documents, help texts and docstrings are short, and without constructions that a reader has to read twice."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from statistics import mean, median

import command_list
import pytest
import typer

from benchmarks.__main__ import app as studies

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").rglob("*.md"))]
LINES_OF_README, LINES = 150, 3000
WORDS, WORDS_OF_PAGE = 15, 20  # of a sentence: the median of all, the mean of a page
BANNED = {  # construction: pattern
    "of which": r"\bof which\b",
    "by which": r"\bby which\b",
    "that of": r"\bthat of\b",
    "is told": r"\b(?:is|are|was|were|be) told\b",
    "what as a noun": r"\bwhat\b(?![^.!|\n]*\?)",
    "a leading preposition or pronoun": r"(?-i:(?:^|[.!?:] |\| )(?:Of|That|It as|By) )",
}
IN_DOCSTRINGS = set(BANNED) - {"that of", "what as a noun"}  # which stand for a quantity where a name would repeat one


def _prose(text: str) -> str:
    """A page without code, addresses of links and tags; a line for each paragraph, item and row of a table."""
    text = re.sub(r"`[^`\n]+`", "code", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S))
    text = re.sub(r"\]\([^)]*\)|<[^>\n]*>", "", text)
    return re.sub(r"(?<!\n)\n(?! *(?:\n|[|#>*-]))", " ", text)


def _sentences(text: str) -> list[str]:
    """Sentences of the paragraphs and items of a page."""
    lines = [line for line in _prose(text).splitlines() if not re.match(r"\||#|!|\[!|:::| {4}[^ -]", line)]
    return [part for line in lines for part in re.split(r"(?<=[.!?])\s+", line.lstrip("-* ")) if part.strip()]


def _found(text: str, names: Collection[str] = tuple(BANNED)) -> list[str]:
    return [
        f"{name}: {text[max(0, at.start() - 30) : at.end() + 30]!r}"
        for name in names
        for at in re.finditer(BANNED[name], text, flags=re.M | re.I)
    ]


def _help() -> Iterator[tuple[str, str]]:
    """Help texts of all commands and options, of the library and of the studies."""
    members = dict(command_list._members(typer.main.get_command(studies)))
    for name, command in [*command_list.COMMANDS.items(), *members.items()]:
        yield name, command.help or ""
        for parameter in command.params:
            yield f"{name} {parameter.name}", getattr(parameter, "help", None) or ""


def _docstrings(node: ast.Module | ast.ClassDef) -> Iterator[str]:
    """Docstrings of a module or class and of the public names in it."""
    yield ast.get_docstring(node) or ""
    for each in node.body:
        if isinstance(each, (ast.FunctionDef, ast.ClassDef)) and not each.name.startswith("_"):
            yield from _docstrings(each) if isinstance(each, ast.ClassDef) else [ast.get_docstring(each) or ""]


def test_docstrings_have_no_banned_construction() -> None:
    paths = [path for package in ("halfspace_sss", "full_geometry") for path in (ROOT / package).rglob("*.py")]
    wrong = {
        str(path.relative_to(ROOT)): [
            found
            for text in _docstrings(ast.parse(path.read_text(encoding="utf-8")))
            for found in _found(_prose(text), IN_DOCSTRINGS)
        ]
        for path in paths
    }
    assert not {path: found for path, found in wrong.items() if found}


def test_documents_have_no_banned_construction() -> None:
    wrong = {str(page.relative_to(ROOT)): _found(_prose(page.read_text(encoding="utf-8"))) for page in PAGES}
    assert not {page: found for page, found in wrong.items() if found}


def test_help_has_no_banned_construction() -> None:
    wrong = {name: _found(" ".join(text.split())) for name, text in _help()}
    assert not {name: found for name, found in wrong.items() if found}


@pytest.mark.parametrize(
    "text",
    [
        "A cone, of which the half is lit.", "The way by which light comes.", "Its error is that of the walk.",
        "The command is told so.", "It shows what is gathered.", "Of the pixels.", "It goes. By photons.",
    ],
)  # fmt: skip
def test_a_construction_is_found(text: str) -> None:
    assert _found(text)


def test_a_question_is_no_construction() -> None:
    assert not _found("What is S? The field says that offsets of walks matter.")


def test_documents_are_short() -> None:
    lines = {page: len(page.read_text(encoding="utf-8").splitlines()) for page in PAGES}
    assert lines[README] <= LINES_OF_README
    assert sum(lines.values()) <= LINES


def test_sentences_are_short() -> None:
    lengths = {page: [len(each.split()) for each in _sentences(page.read_text(encoding="utf-8"))] for page in PAGES}
    assert median(n for page in lengths.values() for n in page) <= WORDS
    long = {str(page.relative_to(ROOT)): mean(ns) for page, ns in lengths.items() if ns and mean(ns) > WORDS_OF_PAGE}
    assert not long
