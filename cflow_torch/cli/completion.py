"""A script that completes commands, groups with their choices (data=, model=, ...) and every setting.

Prints it; leaves nothing. It holds all names, so that completing starts no Python: print it again after an update.

examples:
  cflow completion bash    for this shell: eval "$(cflow completion bash)"; or into a file that ~/.bashrc reads
  cflow completion zsh     likewise in ~/.zshrc, behind compinit
  cflow completion fish    into ~/.config/fish/completions/cflow.fish
"""

from __future__ import annotations

from typing import Dict, List

from cflow_torch.cli import settings
from cflow_torch.types import CFlowError

SHELLS = ("bash", "zsh", "fish")
_OPTIONS = ("--help", "--cfg", "--multirun")


def task(arguments: List[str]) -> None:
    """Run `cflow completion`."""
    if len(arguments) != 1 or arguments[0] not in SHELLS:
        given = " ".join(arguments) or "nothing"
        raise CFlowError(f"completion is for one of {', '.join(SHELLS)}, got {given}: cflow completion bash")
    print(script(arguments[0]))


def script(shell: str) -> str:
    """The script for a shell."""
    from cflow_torch.cli.main import COMMANDS

    words = {command: " ".join(candidates(command)) for command in COMMANDS}
    cases = {
        "bash": "    {name}) all='{words}' ;;",
        "zsh": "    {name}) all=({words}) ;;",
        "fish": "        case {name}\n            printf '%s\\n' {words}",
    }[shell]
    listed = "\n".join(cases.format(name=name, words=text) for name, text in words.items() if text)
    return _TEMPLATES[shell].replace("COMMANDS", " ".join(COMMANDS)).replace("CASES", listed)


def candidates(command: str) -> List[str]:
    """What can stand behind a command: settings end in =, choices are whole."""
    if command == "completion":
        return [*SHELLS, "--help"]
    if not settings.has_settings(command):
        return ["--help"]
    found: Dict[str, None] = {}
    groups = settings.groups(command)
    for group, names in groups.items():
        found.update({f"{group}={name}": None for name in names})
    for key, value in settings.settings(command).items():
        if key in groups:  # picture=flow also sets picture to its own name
            continue
        whole = [f"{key}=true", f"{key}=false"] if isinstance(value, bool) else [f"{key}="]
        found.update(dict.fromkeys(whole))
    return [*found, *_OPTIONS]


# Each offers what begins with the word so far, up to its next dot or equals sign: data, then data. and data=, then ...
_TEMPLATES = {
    "bash": r"""# cflow completion bash
_cflow() {
  local line="${COMP_LINE:0:COMP_POINT}" all='' word part head cur
  local -a words
  read -ra words <<<"$line"
  [[ $line == *[[:space:]] ]] && words+=('')
  cur="${words[${#words[@]}-1]}"
  COMPREPLY=()
  if ((${#words[@]} == 2)); then
    COMPREPLY=($(compgen -W 'COMMANDS --help --version' -- "$cur"))
    return
  fi
  case "${words[1]}" in
CASES
  esac
  for word in $all; do
    [[ $word == "$cur"?* || ( $word == "$cur" && $cur != *= ) ]] || continue
    part="${word#"$cur"}"
    head="${part%%[.=]*}"
    part="${part:0:${#head}+1}"
    COMPREPLY+=("$cur$part")
  done
  if ((${#COMPREPLY[@]} == 0)) && [[ $cur == *=* ]]; then
    COMPREPLY=($(compgen -f -- "${cur#*=}"))
    compopt -o filenames 2>/dev/null
    return
  fi
  ((${#COMPREPLY[@]})) && COMPREPLY=($(printf '%s\n' "${COMPREPLY[@]}" | sort -u))
  if ((${#COMPREPLY[@]} == 1)) && [[ ${COMPREPLY[0]} == *[.=] ]]; then
    compopt -o nospace 2>/dev/null
  fi
  # The shell takes what stands behind = for a word of its own.
  if [[ $COMP_WORDBREAKS == *=* && $cur == *=* ]]; then
    COMPREPLY=("${COMPREPLY[@]#"${cur%"${cur##*=}"}"}")
  fi
}
complete -F _cflow cflow
""",
    "zsh": r"""#compdef cflow
# cflow completion zsh
_cflow() {
  local -a all parts
  local word part rest
  if ((CURRENT == 2)); then
    compadd -- COMMANDS --help --version
    return
  fi
  case "$words[2]" in
CASES
  esac
  for word in $all; do
    [[ $word == "$PREFIX"?* || ( $word == "$PREFIX" && $PREFIX != *= ) ]] || continue
    rest="${word#"$PREFIX"}"
    part="${rest%%[.=]*}"
    parts+=("$PREFIX$part${rest:$#part:1}")
  done
  if ((! $#parts)) && [[ $PREFIX == *=* ]]; then
    compset -P '*='
    _files
    return
  fi
  parts=(${(u)parts})
  compadd -S '' -- ${(M)parts:#*[.=]}
  compadd -- ${parts:#*[.=]}
}
if [[ $funcstack[1] == _cflow ]]; then
  _cflow "$@"
else
  compdef _cflow cflow
fi
""",
    "fish": r"""# cflow completion fish
function __cflow_words
    set -l tokens (commandline -opc)
    switch "$tokens[2]"
CASES
    end
end
function __cflow_offered  # data.root= is no answer to data.root=
    set -l token (string escape --style=regex -- (commandline -ct))
    __cflow_words | string match -rv -- "^$token(?<==)\$"
end
complete -c cflow -f
complete -c cflow -n 'test (count (commandline -opc)) -eq 1' -a 'COMMANDS --help --version'
complete -c cflow -n 'test (count (commandline -opc)) -gt 1' -a '(__cflow_offered)'
function __cflow_is_file
    set -l token (commandline -ct)
    string match -q '*=*' -- $token; or return
    not __cflow_words | string match -rq -- '^'(string escape --style=regex -- $token)'.'
end
complete -c cflow -n __cflow_is_file -F
""",
}
