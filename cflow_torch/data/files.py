"""Helpers of the readers: errors of unreadable files, .npy and JSON files, changes of settings, search for logs."""

from __future__ import annotations

import io
import json
import math
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Callable, Iterator, Sequence

import numpy as np

from cflow_torch.data.atomic import write_text
from cflow_torch.data.paths import PathLike, read_bytes
from cflow_torch.errors import CFlowError, MissingFile

Test = Callable[[Path], bool]
_SHOWN = 5  # changed settings that a message lists
_MAX_TEXT = 400  # characters of a library's message; a damaged name can be a million characters long


@contextmanager
def file_errors(file: Any, hint: str = "copy it again", doing: str = "read") -> Iterator[None]:
    """Turn any exception of the block into one `CFlowError` that names the file.

    Libraries raise nearly anything for a damaged file (OSError, ValueError, KeyError, struct.error, MemoryError, ...).
    `file` is a path, or a text that begins with one. `hint` says what the user can do; `doing` is "read" or "write".
    """
    try:
        yield
    except CFlowError as error:
        if str(file) in str(error):
            raise
        raise CFlowError(f"{file}: {error}") from error
    except FileNotFoundError:
        raise MissingFile(f"{file} is missing; {hint}") from None
    except Exception as error:
        cause = f"{type(error).__name__}: {shortened(error)}"
        guess = "it may be truncated or damaged, " if doing == "read" else ""
        raise CFlowError(f"cannot {doing} {file} ({cause}); {guess}{hint}") from error


def shortened(text: Any) -> str:
    """Return the text on one line of at most 400 characters."""
    line = " ".join(str(text).split())
    return line if len(line) <= _MAX_TEXT else line[:_MAX_TEXT] + " ..."


def check_columns(file: Any, names: Sequence[str], columns: Sequence[str], hint: str = "copy it again") -> None:
    """Raise a `CFlowError` if a needed column is missing or occurs several times; `hint` ends the message."""
    missing = [name for name in columns if name not in names]
    if missing:
        raise CFlowError(f"{file} lacks the columns {missing}; it has {shortened(names)}; {hint}")
    repeated = [name for name in columns if names.count(name) > 1]
    if repeated:
        raise CFlowError(f"{file} has several columns {repeated}; keep one of each")


def distinct_names(names: Sequence[str], padding: str = "") -> list[str]:
    """Number the repetitions of a name: intensity, intensity_2. The name of `padding` stays."""
    counts = [list(names[:k]).count(name) for k, name in enumerate(names, 1)]
    return [name if count == 1 or name == padding else f"{name}_{count}" for name, count in zip(names, counts)]


def read_npy(path: Path, hint: str) -> np.ndarray:
    """Read the array of a .npy file; pickled objects are never loaded. Errors as in `file_errors`."""
    with file_errors(path, hint):
        array = np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
        if not isinstance(array, np.ndarray):
            raise ValueError("it is an archive, not a .npy file")
        return array


def read_json(file: Path, use: Callable[[dict[str, Any]], Any] | None = None) -> Any:
    """Read a JSON file in UTF-8, with or without a byte order mark.

    Each object is replaced by what `use` returns for it, inner objects first. Numbers may be NaN or infinite: we accept
    NaN and Infinity, which Python writes, and read 1e999 as infinity.
    """
    content = read_bytes(file)
    with file_errors(f"{file} as JSON"):
        return json.loads(content.decode("utf-8-sig"), object_hook=use)


def write_json(path: PathLike, value: Any) -> None:
    """Write a JSON file atomically. `json_ready` replaces values that JSON cannot hold."""
    write_text(path, json.dumps(json_ready(value), indent=1, allow_nan=False) + "\n")


def json_ready(value: Any) -> Any:
    """Replace values that JSON cannot hold: tuples by lists, NaN (a mean of no points) by null, infinity by text."""
    if isinstance(value, dict):
        return {str(key): json_ready(member) for key, member in value.items()}
    if isinstance(value, (list, tuple)):
        return [json_ready(member) for member in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else str(value)
    return value


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries into one. Keys are joined by dots. Lists are not flattened."""
    if not isinstance(value, dict):
        return {name: value}
    leaves: dict[str, Any] = {}
    for key, member in value.items():
        leaves.update(flatten(member, f"{name}.{key}" if name else str(key)))
    return leaves


def describe_changes(before: Any, now: Any, ignored: Any = ()) -> str:
    """List the settings that differ between two nested dictionaries, as "key was A, is B; ..."; "" if none do.

    The keys `ignored`, joined by dots as in `flatten`, may differ.
    """
    old, new = flatten(before), flatten(now)
    changed = sorted(key for key in {*old, *new} - set(ignored) if old.get(key) != new.get(key))
    shown = "; ".join(f"{key} was {shortened(old.get(key))}, is {shortened(new.get(key))}" for key in changed[:_SHOWN])
    return shown + (f" and {len(changed) - _SHOWN} more" if len(changed) > _SHOWN else "")


def find_folders(root: Path, is_log: Test, depth: int, what: str, is_passed: Test = lambda folder: True) -> list[Path]:
    """Find the folders that are logs, sorted: `root` itself, or folders at most `depth` levels below it.

    We do not search inside logs, hidden folders, or folders for which `is_passed` is False. A root that is not a folder
    is a `CFlowError`, which says `what` to pass.
    """
    if not root.is_dir():
        raise CFlowError(f"{root} is not a folder; pass {what}")
    found: list[Path] = []
    level = [root]
    for _ in range(depth + 1):
        logs = {folder for folder in level if is_log(folder)}
        found += logs
        children = (child for folder in level if folder not in logs for child in folder.iterdir())
        level = [c for c in children if not c.name.startswith(".") and is_passed(c) and c.is_dir()]
    return sorted(found)
