"""README.md and the guide say what is true: snippets run, commands are understood, the check runs the test command."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import command_list
import pytest
import typer
from test_page_commands import PAGES as IN_ORDER

from benchmarks.__main__ import app as studies
from figures import app as cli

ROOT = Path(__file__).resolve().parent.parent
PAGES = ["README.md", *(str(path.relative_to(ROOT)) for path in sorted((ROOT / "docs").glob("*.md")))]
TEXTS = {page: (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
BLOCKS = {page: re.findall(r"^```(\w+)\n(.*?)^```", text, flags=re.M | re.S) for page, text in TEXTS.items()}
SNIPPETS = {
    page: [text for language, text in blocks if language == "python"]
    for page, blocks in BLOCKS.items()
    if page not in IN_ORDER and any(language == "python" for language, _ in blocks)
}
SNIPPETS |= {  # scripts with cells, whole
    str(path.relative_to(ROOT)): [path.read_text(encoding="utf-8")]
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.py"))
}
COMMANDS = list(
    dict.fromkeys(
        part.strip()
        for blocks in BLOCKS.values()
        for language, text in blocks
        if language == "bash"
        for line in text.splitlines()
        for part in line.split("#")[0].split("&&")
        if part.strip().startswith(("halfspace-sss", "python -m benchmarks"))
    )
)
RUN = """
import contextlib
import dataclasses
import io
import json
import os
import sys
import traceback

import one_thread
import quick_kernels
import quick_light
from full_geometry import inverse

quick_kernels.compile_quickly()
one_thread.work_in_one_thread()
quick_light.gather_by_few(setattr)
fit = inverse.fit
inverse.fit = lambda *arguments, settings: fit(*arguments, settings=dataclasses.replace(settings, steps=2))
top = os.getcwd()
for page, texts in json.loads(sys.argv[1]).items():
    os.makedirs(os.path.join(top, page))
    os.chdir(os.path.join(top, page))
    printed, error = [], ""
    try:
        for number, text in enumerate(texts):
            told = io.StringIO()
            with contextlib.redirect_stdout(told):
                exec(compile(text, f"snippet {number}", "exec"), {"__name__": "__main__"})
            printed.append(told.getvalue())
    except Exception:
        error = traceback.format_exc()
    print("\\nRAN", json.dumps([page, printed, error]), flush=True)
"""


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[list[str], str]]:
    """By page, what each snippet printed, and an error; one process, since all share its imports and kernels."""
    run = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps(SNIPPETS)], cwd=tmp_path_factory.mktemp("pages"), capture_output=True,
        text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    rows = [json.loads(line.removeprefix("RAN ")) for line in run.stdout.splitlines() if line.startswith("RAN ")]
    assert run.returncode == 0 and [page for page, *_ in rows] == list(SNIPPETS), run.stderr
    return {page: (printed, error) for page, printed, error in rows}


@pytest.mark.slow
@pytest.mark.parametrize("page", SNIPPETS)
def test_snippets_run_and_print(page: str, ran: dict[str, tuple[list[str], str]]) -> None:
    printed, error = ran[page]
    assert not error, error
    assert len(printed) == len(SNIPPETS[page])
    assert all(text.strip() for text in printed)


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_is_understood(line: str) -> None:
    name, app, words = ("halfspace-sss", cli.app, 1) if line.startswith("halfspace-sss") else ("benchmarks", studies, 3)
    arguments, command = shlex.split(line)[words:], typer.main.get_command(app)
    while hasattr(command, "get_command"):  # groups, down to the command itself
        name, *arguments = arguments
        command = command.get_command(None, name)
        assert command is not None, name
    command.make_context(name, arguments)


def test_every_command_is_shown() -> None:
    shown = [" ".join(line.split()[1:3]) for line in COMMANDS if line.startswith("halfspace-sss")]
    missing = [name for name in command_list.COMMANDS if not any(f"{words} ".startswith(f"{name} ") for words in shown)]
    assert not missing


def test_links_to_files_and_headings_hold() -> None:
    for page, text in TEXTS.items():
        for target, heading in re.findall(r"\]\(([^)#:\s]*)(?:#([^)]+))?\)", text):
            file = (ROOT / page).parent / target if target else ROOT / page
            assert file.is_file(), (page, target)
            if heading:
                titles = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), flags=re.M)
                slugs = [re.sub(r"[\s-]+", "-", re.sub(r"[^\w\s-]", "", title).strip().lower()) for title in titles]
                assert heading in slugs, (page, target, heading)


def test_the_check_installs_and_tests_as_the_readme_says() -> None:
    (line,) = [line for _, text in BLOCKS["README.md"] for line in text.splitlines() if line.endswith("&& pytest")]
    check = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    for command in line.split(" && "):
        assert any(line == command or line.startswith(f"{command} ||") for line in check), command
