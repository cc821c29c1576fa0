"""The commands and Python blocks of the documents and of `cflow --help`, as a reader would copy them."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Dict, Iterator, List, Tuple

ROOT = Path(__file__).resolve().parents[2]
SHELLS = ("bash", "sh", "console", "shell")
# What a command begins with; settings of the environment may stand before it.
PROGRAMS = r"cflow|python[\d.]*|pip|pytest|torchrun|sbatch|srun|ray|jupyter|git|\./\S+|scripts/\S+|\.ci/run|exec|export"
COMMAND = re.compile(rf"(?:[A-Z_]+=\S* )*(?:{PROGRAMS})(?= |$)")
_FENCE = re.compile(r"^( *)(```+)(\w*)[^\n]*\n(.*?)^\1\2 *$", re.M | re.S)
_INLINE = re.compile(r"(?<!`)(`{1,2})(?!`)(.+?)(?<!`)\1(?!`)", re.S)


@dataclass(frozen=True)
class Snippet:
    """One command, or one block of Python.

    Args:
        text: a command is one line, without its comment.
        file: document, relative to the root.
        line: where it begins.
        is_inline: it stands in a sentence or a table.
    """

    text: str
    file: str
    line: int
    is_inline: bool = False

    @property
    def words(self) -> List[str]:
        """As a shell splits it."""
        return shlex.split(self.text)

    @property
    def is_script(self) -> bool:
        """A whole shell script (`#!`), not one command."""
        return self.text.startswith("#!")

    @property
    def is_elided(self) -> bool:
        """`...` stands for the reader's own settings."""
        return "..." in self.text.split()

    @property
    def is_mention(self) -> bool:
        """A name in a sentence, such as `cflow eval` or `cflow eval -m`: nothing is asked to be run."""
        given = [word for word in self.text.split() if not word.startswith("-")]
        if "COMMAND" in given:
            return True
        return self.is_inline and given[0] in ("cflow", "torchrun") and len(given) <= 2 and given[-1] != "info"


def documents() -> List[Path]:
    """README, contributing, everything under docs/ and the notebooks."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    notebooks = ROOT / "notebooks"
    return [*found, *sorted(notebooks.glob("*.md")), *sorted(notebooks.glob("*.ipynb"))]


def markdown_of(file: Path) -> str:
    """Text of a document; of a notebook, its Markdown cells."""
    text = file.read_text(encoding="utf-8")
    if file.suffix != ".ipynb":
        return text
    cells = (cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown")
    return "\n\n".join("".join(cell["source"]) for cell in cells) + "\n"


def blocks(file: Path) -> Iterator[Tuple[str, str, int]]:
    """Language, text and first line of each fenced block."""
    text = markdown_of(file)
    for match in _FENCE.finditer(text):
        indent = len(match[1])
        lines = [line[indent:] for line in match[4].splitlines(keepends=True)]
        yield match[3], "".join(lines), text.count("\n", 0, match.start(4)) + 1


def without_comment(line: str) -> str:
    """A shell line up to its comment."""
    for match in re.finditer(r"(^|\s)#", line):
        if line[: match.start()].count("'") % 2 == 0 and line[: match.start()].count('"') % 2 == 0:
            return line[: match.start()].rstrip()
    return line.rstrip()


def commands_of_block(text: str) -> Iterator[Tuple[int, str]]:
    """Offset of the line and text of each command; a block that is a script (`#!`) comes whole, then its commands."""
    if text.startswith("#!"):
        yield 0, text.strip()
    started, parts = 0, []  # type: Tuple[int, List[str]]
    for offset, line in enumerate(text.splitlines()):
        line = without_comment(line.strip())
        line = line[2:] if line.startswith("$ ") else line  # a prompt
        if not parts:
            started = offset
        parts.append(line.rstrip("\\").strip())
        if not line.endswith("\\"):
            joined = re.sub(r"^exec ", "", " ".join(part for part in parts if part))
            parts = []
            if joined:
                yield started, joined


def examples_of_help() -> Iterator[Snippet]:
    """What `cflow --help` and `cflow COMMAND --help` show; two blanks end a command."""
    for file in sorted((ROOT / "cflow_torch" / "cli").glob("*.py")):
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
            match = re.match(r"\s*(cflow [a-z]+( \S+)*)(  |$)", line)
            if match:
                yield Snippet(match[1], str(file.relative_to(ROOT)), number)


def command_blocks() -> Iterator[Tuple[str, int, List[str]]]:
    """Document, line and commands of each block of them."""
    for file in documents():
        for language, block, line in blocks(file):
            if language in SHELLS and not block.startswith("#!"):
                yield str(file.relative_to(ROOT)), line, [command for _, command in commands_of_block(block)]


def commands() -> List[Snippet]:
    """Every command of every document, each text once; where it is first, but in a block rather than in a sentence."""
    found: Dict[str, Snippet] = {}
    inline: Dict[str, Snippet] = {}
    for file in documents():
        name, text = str(file.relative_to(ROOT)), markdown_of(file)
        for language, block, line in blocks(file):
            for offset, command in commands_of_block(block) if language in SHELLS else ():
                found.setdefault(command, Snippet(command, name, line + offset))
        prose = _FENCE.sub(lambda match: "\n" * match[0].count("\n"), text)
        for match in _INLINE.finditer(prose):
            command = " ".join(match[2].replace("\\|", "|").split())
            if COMMAND.match(command) and " " in command or command.startswith(("./scripts/", ".ci/")):
                snippet = Snippet(command, name, prose.count("\n", 0, match.start()) + 1, is_inline=True)
                inline.setdefault(command, snippet)
    for snippet in examples_of_help():
        found.setdefault(snippet.text, snippet)
    return [*found.values(), *(snippet for text, snippet in inline.items() if text not in found)]


def python_blocks() -> Dict[str, List[Snippet]]:
    """Document -> its blocks of Python, in order. Notebooks are executed elsewhere."""
    found: Dict[str, List[Snippet]] = {}
    for file in documents():
        name = str(file.relative_to(ROOT))
        for language, block, line in blocks(file) if file.suffix == ".md" else ():
            if language in ("python", "py"):
                found.setdefault(name, []).append(Snippet(block, name, line))
    return found


def commands_without_language() -> List[str]:
    """Places of blocks that hold commands but do not say that they are shell."""
    return [
        f"{file.relative_to(ROOT)}:{line}"
        for file in documents()
        for language, block, line in blocks(file)
        if language not in (*SHELLS, "python", "py") and any(map(COMMAND.match, block.splitlines()))
    ]


if __name__ == "__main__":
    for snippet in commands():
        print(f"{snippet.file}:{snippet.line}{' (inline)' if snippet.is_inline else ''}: {snippet.text}")
