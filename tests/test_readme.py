"""README.md says what is true: its snippets run, its commands are understood, and the check runs its test command."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from halfspace_sss.cli import app as cli

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", README, flags=re.MULTILINE | re.DOTALL)
SNIPPETS = [text for language, text in BLOCKS if language == "python"]
COMMANDS = [
    part.strip()
    for language, text in BLOCKS
    if language == "bash"
    for line in text.splitlines()
    for part in line.split("#")[0].split("&&")
    if part.strip().startswith("halfspace-sss")
]


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_a_snippet_runs(number: int, tmp_path: Path) -> None:
    run = subprocess.run([sys.executable, "-c", SNIPPETS[number]], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout


@pytest.mark.parametrize("line", COMMANDS)
def test_a_command_is_understood(line: str) -> None:
    _, name, *arguments = shlex.split(line)
    group = typer.main.get_command(cli.app)
    command = group.get_command(None, name)
    assert command is not None, name
    command.make_context(name, arguments)


def test_every_command_is_shown() -> None:
    assert set(cli._OWN) <= {line.split()[1] for line in COMMANDS}


def test_links_to_files_hold() -> None:
    for target in re.findall(r"\]\(([^)#:]+)\)", README):
        assert (ROOT / target).is_file(), target


def test_the_check_installs_and_tests_as_the_readme_says() -> None:
    (line,) = [line for _, text in BLOCKS for line in text.splitlines() if line.endswith("&& pytest")]
    check = (ROOT / ".ci" / "run").read_text(encoding="utf-8").splitlines()
    for command in line.split(" && "):
        assert any(line == command or line.startswith(f"{command} ||") for line in check), command
