"""Prints a script for TAB completion of commands, groups with their choices (data=, model=, ...), settings and paths.

examples:
  cflow completion bash    for this shell: eval "$(cflow completion bash)"; or write it to a file that ~/.bashrc reads
  cflow completion zsh     the same for ~/.zshrc, after compinit
  cflow completion fish    write it to ~/.config/fish/completions/cflow.fish
"""

from __future__ import annotations

from glob import escape, glob
from pathlib import Path
from typing import Iterator

from cflow_torch.cli.choices import CONFIGS, groups, settings
from cflow_torch.errors import CFlowError

# At each TAB the script runs `cflow completion words LINE`, which prints the completions of the last word of a line.
# Bash completes only what follows the last = of a word. Where nothing fits, the shells offer files.
_BASH = r"""_cflow() {
  local IFS=$'\n' cur="${COMP_LINE:0:$COMP_POINT}"
  COMPREPLY=($(cflow completion words "$cur"))
  cur="${cur##*[[:space:]]}"
  [[ $COMP_WORDBREAKS != *=* || $cur != *=* ]] || COMPREPLY=("${COMPREPLY[@]#"${cur%"${cur##*=}"}"}")
}
complete -o nospace -o default -F _cflow cflow"""
_SHELLS = {
    "bash": _BASH,
    "zsh": f"autoload -U +X bashcompinit && bashcompinit\n{_BASH}",
    "fish": "complete -c cflow -a '(cflow completion words (commandline -cp) | string trim)'",
}


def task(arguments: list[str]) -> None:
    """Run `cflow completion`."""
    if len(arguments) == 2 and arguments[0] == "words":
        return print("\n".join(completions(arguments[1])))
    if len(arguments) != 1 or arguments[0] not in _SHELLS:
        given = " ".join(arguments) or "nothing"
        raise CFlowError(f"completion takes one of {', '.join(_SHELLS)}, got {given}: cflow completion bash")
    return print(_SHELLS[arguments[0]])


def completions(line: str) -> list[str]:
    """Complete the last word of a line: up to its next dot or equals sign, or as a whole word with a space after it."""
    *before, last = line.split(" ")
    found = set()
    for word in _candidates(before[1:]):
        if word.startswith(last) and word != last:
            rest = word[len(last) :]
            end = min((rest.index(mark) + 1 for mark in ".=" if mark in rest), default=0)
            found.add(last + (rest[:end] if end else f"{rest} "))
    if "=" in last and not found:
        key, _, path = last.partition("=")
        found = {f"{key}={name}{'/' if Path(name).is_dir() else ' '}" for name in glob(f"{escape(path)}*")}
    return sorted(found)


def _candidates(before: list[str]) -> Iterator[str]:
    """Whole words that may follow the words after `cflow`. A setting ends with an equals sign."""
    from cflow_torch.cli.main import COMMANDS

    if not before:
        yield from (*COMMANDS, "--help", "--version")
    elif not (CONFIGS / f"{before[0]}.yaml").exists():
        yield from (*_SHELLS, "--help") if before[0] == "completion" else ("--help",)
    else:
        choices = groups(before[0])
        yield from (f"{group}={name}" for group, names in choices.items() for name in names)
        for key, value in settings(before[0]).items():
            if key not in choices:  # `picture` is both a group and a setting
                yield from (f"{key}=true", f"{key}=false") if isinstance(value, bool) else (f"{key}=",)
        yield from ("--help", "--cfg", "--multirun")
