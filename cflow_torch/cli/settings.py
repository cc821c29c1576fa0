"""All help: of each command, and `cflow settings`, which lists all settings."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, Iterator, NamedTuple

from cflow_torch.cli.choices import choices, files, known_settings
from cflow_torch.cli.commands import COMMANDS, ENGINES, PICTURES, WITH_SETTINGS, Command, Plot, own_fields
from cflow_torch.config import METHODS, PRESETS
from cflow_torch.errors import CFlowError, near
from cflow_torch.setting import Settings, describe_limits

_PAGE = """# Settings

Settings have the same names in Python, `make_config("paper", max_speed=30.0)`, on the command line, `model=paper
model.max_speed=30`, and in a sweep, `-m model.num_history=0,2,4`. null is None in Python. Words such as Alg. clustering
are labels of the paper. If a name or a value is wrong, the error message lists what is allowed."""
_IN_FILES = ("data", "experiment", "row")  # groups whose choices are YAML files


def task(arguments: list[str]) -> None:
    if not arguments:
        sections = (f"## {section.title}\n\n" + "\n".join(section.lines) for section in _sections())
        print("\n\n".join([_PAGE, *sections]))
    elif any(word.startswith("-") for word in arguments):
        raise CFlowError(f"settings takes names, got {' '.join(arguments)}")
    else:
        print("\n\n".join(text for name in arguments for text in _about(name)))


def help_of(name: str) -> str:
    """Return what a command does, and its settings with the choices of its groups, if it has settings."""
    kind = COMMANDS[name]
    text = f"cflow {name}: {kind.SUMMARY}\n\n{inspect.cleandoc(kind.__doc__ or '')}\n"
    if not issubclass(kind, Command):
        return text
    of_groups = [f"{group}={'|'.join(choices(group))}" for group in kind.groups()]
    lines = [*setting_lines(kind), *of_groups]
    for picture, own in PICTURES.items() if kind is Plot else ():
        preset = f" (model={own.PRESET})" if own.PRESET else ""
        lines.append(f"picture={picture}:  # {str(own.__doc__).partition(chr(10))[0]}{preset}")
        lines += [f"  {line}" for line in setting_lines(own, Plot)]
    lines.append("data.NAME, model.NAME, ...: `cflow settings` lists them")
    return "\n  ".join([f"{text}\nsettings:", *lines]) + "\n"


def setting_lines(kind: type[Settings], base: type[Settings] | None = None) -> Iterator[str]:
    """Yield a line for each setting of a class that is not in `base`: "name: default  # meaning"."""
    known = {f.name for f in fields(base)} if base is not None else set()  # type: ignore[arg-type]
    for f in own_fields(kind):
        if f.name in known:
            continue
        if issubclass(f.metadata["kind"], Settings):
            yield f"{f.name}:  # {f.metadata['help']}"
            yield from (f"  {line}" for line in setting_lines(f.metadata["kind"]))
        else:
            yield f"{f.name}: {as_yaml(f.default)}  # {f.metadata['help']}"


def as_yaml(value: Any) -> str:
    """Return a default on one line, as YAML writes it."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(as_yaml, value))}]"
    if isinstance(value, float) and value in (float("inf"), float("-inf")):
        return ".inf" if value > 0 else "-.inf"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


class Section(NamedTuple):
    """A section of the page. `cflow settings` finds it by its title or one of its `names`."""

    title: str
    lines: list[str]
    names: tuple[str, ...] = ()


def _sections() -> Iterator[Section]:
    """Yield the sections of the page: methods, commands, engines, pictures, and the choices in YAML files."""
    for method in METHODS:
        presets = [preset for preset, config in PRESETS.items() if config.method == method]
        chosen = [f"model={preset}" for preset in presets]
        title = f"Method `{method}`: {', '.join(chosen)}"
        yield Section(title, _method_table(method, presets), (method, *presets, *chosen, "model"))
    for name, command in WITH_SETTINGS.items():
        yield Section(f"cflow {name}", _block(f"cflow {name}: {command.SUMMARY}.", setting_lines(command)), (name,))
    for name, engine in ENGINES.items():
        yield Section(f"engine={name}", _block(str(engine.__doc__), setting_lines(engine)))
    for name, picture in PICTURES.items():
        about = str(picture.__doc__).partition("\n")[0]
        yield Section(f"picture={name}", _block(about, setting_lines(picture, Plot)))
    for group in _IN_FILES:
        for file in files(group):
            yield Section(f"{group}={file.stem}", ["```yaml", *_text_of(file).splitlines(), "```"])


def _text_of(file: Path) -> str:
    """Return the YAML of a choice; the settings of all data sets come after its own."""
    text = file.read_text(encoding="utf-8")
    about, extends, own = text.partition("defaults:\n  - _log\n\n")
    if extends:
        of_all = file.with_name("_log.yaml").read_text(encoding="utf-8").partition("\n")[2]
        text = f"{about}{own}{of_all}"
    return text.strip()


def _method_table(method: str, presets: list[str]) -> list[str]:
    """Return the rows of a table of all settings of a method."""
    rows = ["| setting | default | presets | allowed | meaning |", "|---|---|---|---|---|"]
    for f in fields(METHODS[method]):
        changed = [preset for preset in presets if getattr(PRESETS[preset], f.name) != f.default]
        cells = (
            f"`model.{f.name}`",
            f"`{as_yaml(f.default)}`",
            ", ".join(f"{preset} `{as_yaml(getattr(PRESETS[preset], f.name))}`" for preset in changed),
            describe_limits(f.metadata),
            f.metadata["help"],
        )
        rows.append(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |")
    return rows


def _block(about: str, lines: Iterator[str]) -> list[str]:
    return ["```yaml", f"# {about}", *lines, "```"]


def _about(name: str) -> list[str]:
    """Return the sections of this name, the first lines of the choices of a group, and the lines of a setting."""
    sections = list(_sections())
    found = ["\n".join([f"## {each.title}", "", *each.lines]) for each in sections if name in (each.title, *each.names)]
    choices = [each for each in sections if each.title.startswith(f"{name}=")]
    if choices:
        found.append("\n".join(f"{each.title:28} {_about_choice(each)}" for each in choices))
    titles_of: dict[str, list[str]] = {}  # line of a setting -> sections
    for section in sections:
        if name not in (section.title, *section.names) and section not in choices:
            for line in _lines_of(name, section):
                titles_of.setdefault(line.strip(), []).append(section.title)
    found += [f"{', '.join(titles)}:\n  {line}" for line, titles in titles_of.items()]
    if not found:
        known = [key for command in WITH_SETTINGS.values() for key in known_settings(command)]
        known += [one for each in sections for one in (each.title, *each.names)]
        raise CFlowError(f"settings {name}: nothing has this name{near(name, known)}; `cflow settings` lists all")
    return found


def _about_choice(section: Section) -> str:
    return next(line[2:] for line in section.lines if re.match("# [^@]", line))


def _lines_of(name: str, section: Section) -> Iterator[str]:
    """Yield the lines of a section that define a setting."""
    group, _, own = name.rpartition(".")
    is_near = group in ("", "model", section.title.partition("=")[0])
    if is_near or any(line.startswith(f"{group}:") for line in section.lines):
        yield from filter(re.compile(rf"(\| `model\.| *){re.escape(own)}(`|:)").match, section.lines)
