"""Prints a script for TAB completion of commands, groups with their choices (data=, model=, ...) and all settings.

The script contains all names, so that completion does not start Python. Print it again after an update.

examples:
  cflow completion bash    for this shell: eval "$(cflow completion bash)"; or write it to a file that ~/.bashrc reads
  cflow completion zsh     the same for ~/.zshrc, after compinit
  cflow completion fish    write it to ~/.config/fish/completions/cflow.fish
"""

from __future__ import annotations

from cflow_torch.cli.choices import CONFIGS, groups, settings
from cflow_torch.errors import CFlowError

# The script offers names that begin with the current word, up to the next dot or equals sign: data, then data. and
# data=, and so on. For bash, the text after = is a word of its own.
_BASH = r"""
_cflow() {
  local line="${COMP_LINE:0:$COMP_POINT}" all word rest head cur
  cur="${line##*[[:space:]]}"
  case "${COMP_WORDS[1]}-$COMP_CWORD" in
    *-1) all='COMMANDS --help --version' ;;
CASES
  esac
  COMPREPLY=()
  for word in $all; do
    [[ $word == "$cur"* && $word != "$cur" ]] || continue
    rest="${word:${#cur}}"; head="${rest%%[.=]*}"
    COMPREPLY+=("$cur${rest:0:${#head}+1}")
  done
  if ((${#COMPREPLY[@]})); then
    COMPREPLY=($(printf '%s\n' "${COMPREPLY[@]}" | sort -u))
  elif [[ $cur == *=* ]]; then
    for word in "${cur#*=}"*; do
      [[ -d $word ]] && COMPREPLY+=("${cur%%=*}=$word/") || [[ ! -e $word ]] || COMPREPLY+=("${cur%%=*}=$word")
    done
  fi
  [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} != *[.=/] ]] && compopt +o nospace 2>/dev/null
  [[ $COMP_WORDBREAKS != *=* || $cur != *=* ]] || COMPREPLY=("${COMPREPLY[@]#"${cur%"${cur##*=}"}"}")
}
complete -o nospace -F _cflow cflow"""
_ZSH = "autoload -U +X bashcompinit && bashcompinit" + _BASH
_FISH = r"""complete -c cflow -f
complete -c cflow -n 'test (count (commandline -opc)) -eq 1' -a 'COMMANDS --help --version'
CASES
complete -c cflow -n "string match -qr '^(output|archive|frames|masks|flow|data.*)=' -- (commandline -ct)" -F"""
_SHELLS = {
    "bash": (_BASH, "    {name}-*) all='{words}' ;;"),
    "zsh": (_ZSH, "    {name}-*) all='{words}' ;;"),
    "fish": (_FISH, "complete -c cflow -n 'contains {name} (commandline -opc)[2]' -a '{words}'"),
}


def task(arguments: list[str]) -> None:
    """Run `cflow completion`."""
    if len(arguments) != 1 or arguments[0] not in _SHELLS:
        given = " ".join(arguments) or "nothing"
        raise CFlowError(f"completion takes one of {', '.join(_SHELLS)}, got {given}: cflow completion bash")
    print(script(arguments[0]))


def script(shell: str) -> str:
    """The completion script for a shell."""
    from cflow_torch.cli.main import COMMANDS

    template, case = _SHELLS[shell]
    cases = "\n".join(case.format(name=name, words=" ".join(candidates(name))) for name in COMMANDS)
    return f"# cflow completion {shell}\n{template}".replace("COMMANDS", " ".join(COMMANDS)).replace("CASES", cases)


def candidates(command: str) -> list[str]:
    """Completions of a command: settings end in =, choices are complete."""
    if not (CONFIGS / f"{command}.yaml").exists():
        return [*(_SHELLS if command == "completion" else ()), "--help"]
    choices = groups(command)
    found = [f"{group}={name}" for group, names in choices.items() for name in names]
    for key, value in settings(command).items():
        if key not in choices:  # `picture` is both a group and a setting
            found += [f"{key}=true", f"{key}=false"] if isinstance(value, bool) else [f"{key}="]
    return list(dict.fromkeys([*found, "--help", "--cfg", "--multirun"]))
