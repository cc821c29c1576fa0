"""What Hydra refuses, said in one line with what to do next."""

from __future__ import annotations

import re
import shlex
import traceback
from typing import Optional

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from cflow_torch.cli import settings

# What Hydra raises itself for some calls: a number of thousands of digits, model=null, ~model.pixel_sizes.0.
_OF_PYTHON = (ValueError, TypeError, LookupError, AttributeError, AssertionError)


def explain(error: Exception, command: str) -> Optional[str]:
    """The message for a call that Hydra refuses; None if the error is none of the caller's."""
    if isinstance(error, MissingConfigException):
        return _unknown_choice(error, command)
    if isinstance(error, OverrideParseException):
        wrong = str(error.override)
        if "=" not in wrong:
            return f"{wrong!r} is no setting: give NAME=VALUE, `cflow {command} --help` has examples"
        return f"cannot read {wrong!r}: {_readable(wrong)}"
    message = str(error)
    if not isinstance(error, (HydraException, OmegaConfBaseException)):
        if not isinstance(error, _OF_PYTHON) or not _is_of_hydra(error):
            return None
        match = re.match(r"invalid literal for int\(\) with base 10: (.*)|Index (.*) \(str\) is not an int", message)
        if match:  # model.pixel_sizes.x=1
            message = f"{match[1] or match[2]} is no place in a list: give all of it, 'NAME=[A,B]'"
        return f"{' '.join(message.split())}; `cflow {command} --help` has examples"
    match = re.match(r"Could not override '([^']+)'", message)
    if match:
        known = [*settings.groups(command), *settings.settings(command)]
        key = match[1].lstrip("+~")
        owners = settings.owners(command, key)
        if owners:
            return f"setting {key!r} belongs to {' or '.join(owners)}: give that as well, or leave it out"
        return f"unknown setting {key!r}{settings.near(key, known)}: `cflow {command} --cfg job` prints every one"
    match = re.match(r"Ambiguous value for argument '([^=']+)=([^']+)'", message)
    if match:
        key, values = match.groups()
        return f"{key}={values} is more than one value: add -m to run each, or write '{key}=[{values}]' for a list"
    first, *more = message.splitlines() or [type(error).__name__]
    more = more or str(error.__cause__ or "").splitlines()[:1]  # "Error merging override" does not say why
    rest = f" ({'; '.join(line.strip() for line in more if line.strip())})" if more else ""
    return f"{first}{rest}; `cflow {command} --cfg job` prints every setting"


def _is_of_hydra(error: Exception) -> bool:
    """Whether it was raised in Hydra's own code, or its parser's."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return str(frame.f_globals.get("__name__")).partition(".")[0] in ("hydra", "omegaconf", "antlr4")


def _readable(wrong: str) -> str:
    """How an override that Hydra's parser refuses can be written."""
    key, _, value = wrong.partition("=")
    if value[:1] in ("[", "{", "(", "'", '"'):
        return """write 'NAME=[A,B]' for a list, 'NAME=["A",B]' if A has special characters, in the shell's quotes"""
    quoted = value.replace('"', r"\"")
    both = shlex.quote(f'{key}="{quoted}"')
    return f"text with special characters takes two pairs of quotes, the inner ones for Hydra: {both}"


def _unknown_choice(error: MissingConfigException, command: str) -> str:
    group, _, name = str(error.missing_cfg_file or "").rpartition("/")
    if group.startswith("hydra/"):
        kind = group.partition("/")[2]
        packages = "hydra-joblib-launcher hydra-submitit-launcher hydra-optuna-sweeper"
        return f"no {kind} {name!r} here: joblib, submitit and optuna come with pip install {packages}"
    known = settings.choices(group)
    if not known:
        return f"{error}; `cflow {command} --help` has examples".replace("\n", " ")
    return f"{group}={name}{settings.near(name, known)}: give one of {', '.join(known)}"


def format_bug(error: BaseException) -> str:
    """Traceback from the command on, without Hydra's own frames, and what to do with it."""
    trace = error.__traceback__
    inner = trace
    while inner is not None and inner.tb_frame.f_code.co_name != "task":
        inner = inner.tb_next
    lines = traceback.format_exception(type(error), error, inner or trace)
    return "".join(lines) + "this is a fault of cflow, not of the call: report it with the lines above and `cflow info`"
