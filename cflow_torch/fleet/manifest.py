"""What the results in a folder were made from: method, data settings, versions, input. Nothing else may join them.

OUTPUT/manifest.json              identity of the run and its hash
OUTPUT/<log id>/manifest.json     the log: its time stamps, digests of its first, middle and last sweep
OUTPUT/<log id>/<ns>.feather      a complete frame: files take their names when they are on disk
OUTPUT/<log id>/tracks.parquet    objects through time, made of all frames of a log when they are complete
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Mapping, Sequence

import numpy as np
import torch

from cflow_torch import __version__
from cflow_torch.config import Config
from cflow_torch.data.atomic import remove_stale, write_text
from cflow_torch.data.flow_file import CONTENTS
from cflow_torch.data.json_file import describe_changes, json_ready, read_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import forget_listings, is_remote, remote_errors
from cflow_torch.types import CFlowError, as_numpy

MANIFEST = "manifest.json"
_FORMAT = 1
_ENDING = b"ARROW1"  # of every feather file
_OURS = re.compile(r"[0-9]+\.feather|manifest\.json|tracks\.parquet|\..+\.tmp")
_REMEDY = "give output=FOLDER, or overwrite=true"


def make_identity(
    config: Config, reader: str, settings: Mapping[str, Any], contents: Sequence[str] = CONTENTS
) -> dict[str, Any]:
    """What decides the bytes of a result, besides the sweeps: method (not its `max_memory`), data settings, what is
    written, versions.

    A CPU build and a CUDA build of one torch version count as the same.
    """
    versions = {
        "cflow_torch": __version__,
        "torch": str(torch.__version__).split("+")[0],
        "numpy": np.__version__,
    }
    data = {"reader": reader, **{key: value for key, value in settings.items() if key != "check"}}
    method = {key: value for key, value in asdict(config).items() if key != "max_memory"}
    identity = json_ready(
        {"format": _FORMAT, "method": method, "data": data, "contents": contents, "versions": versions}
    )
    return {**identity, "hash": hashlib.sha256(_text(identity).encode()).hexdigest()}


def claim_folder(output: Path, identity: Mapping[str, Any], resume: bool, overwrite: bool, alone: bool) -> None:
    """Make sure that the folder holds results of this identity only, and say so in its manifest.

    Args:
        output: folder of the run.
        identity: of `make_identity`.
        resume: continue what an earlier run of the same identity left.
        overwrite: remove what earlier runs left.
        alone: no other shard works in this folder.

    Raises:
        CFlowError: it holds results that must not be mixed with these.
    """
    forget_listings(output)
    why = find_conflict(output, identity, resume or overwrite)
    if why is not None and not overwrite:
        raise CFlowError(f"{output} holds results of another run{why}: {_REMEDY}")
    if why is not None and not alone:  # shards that begin together cannot agree who removes them
        raise CFlowError(f"{output} holds results of another run{why}: remove the folder, or give output=FOLDER")
    if overwrite and alone and output.is_dir():
        _clear(output)
    remove_stale(output)
    if not (output / MANIFEST).exists():
        write_text(output / MANIFEST, _text(identity))


def find_conflict(output: Path, identity: Mapping[str, Any], resume: bool) -> str | None:
    """Why results of this identity must not join those in the folder, to follow a noun; None if they may."""
    before = _read(output / MANIFEST)
    if before is None:
        return None
    changed = describe_changes(before, identity, ["hash"])
    if changed:
        return f" ({changed})"
    return None if resume else " with the same settings (resume=true continues it)"


def claim_log(folder: Path, log: Log, run: str) -> None:
    """Make sure that the frames in a log's folder were made from this very log, and say so in its manifest.

    Raises:
        CFlowError: the log has changed since, or another log has its name.

    Cost: reads three sweeps.
    """
    now = _describe_log(log, run)
    if _read(folder / MANIFEST) is None:
        write_text(folder / MANIFEST, _text(now))
    before = _read(folder / MANIFEST) or {}  # again: another log of that name may have been quicker
    if before.get("run") != run:
        raise CFlowError(f"{folder} holds flow of another run: remove that folder, or give output=FOLDER")
    is_same = all(before.get(key) == now[key] for key in ("log_id", "timestamps"))
    both = now["sweeps"].keys() & (before.get("sweeps") or {}).keys()
    if not is_same or any(before["sweeps"][key] != now["sweeps"][key] for key in both):
        raise CFlowError(
            f"{folder} holds flow of other sweeps (the log has changed since, or two logs have one name): "
            "remove that folder, or give output=FOLDER"
        )


def _describe_log(log: Log, run: str) -> dict[str, Any]:
    """Manifest of a log. A sweep that cannot be read has no digest; its frames will say why."""
    stamps = [int(stamp) for stamp in log.timestamps]
    digests = {}
    for index in sorted({0, len(stamps) // 2, len(stamps) - 1} & set(range(len(stamps)))):
        with suppress(CFlowError, OSError):
            digests[str(stamps[index])] = _digest(log, index)
    return {"run": run, "log_id": log.log_id, "timestamps": stamps, "sweeps": digests}


def complete_frames(folder: Path) -> set[int]:
    """Time stamps whose flow is in a log's folder, whichever worker put it there.

    None where the log's manifest is gone, for nobody knows then what they were made from; and none whose file does not
    end as it was written (a power cut, a copy that broke off).

    Cost: on this machine, the last bytes of every file are read.
    """
    forget_listings(folder)
    with remote_errors(folder):
        names = [file.name for file in folder.iterdir()] if folder.is_dir() else []
    if MANIFEST not in names:
        return set()
    frames = [name for name in names if re.fullmatch(r"[0-9]{1,20}\.feather", name)]
    return {int(name[: -len(".feather")]) for name in frames if is_remote(folder) or _is_whole(folder / name)}


def frame_file(folder: Path, timestamp: int) -> Path:
    """Where the flow of one frame lies."""
    return folder / f"{timestamp}.feather"


def _is_whole(file: Path) -> bool:
    """Whether a feather file ends as such files do."""
    with suppress(OSError), open(file, "rb") as opened:
        opened.seek(-len(_ENDING), os.SEEK_END)
        return opened.read() == _ENDING
    return False


def _digest(log: Log, index: int) -> str:
    """Of all that a sweep gives to the method."""
    sweep, digest = log.sweep(index), hashlib.sha256()
    for values in (sweep.points, sweep.is_ground, sweep.pose):
        digest.update(b"none" if values is None else as_numpy(values).tobytes())
    return digest.hexdigest()


def _clear(output: Path) -> None:
    """Remove the results of a run, and nothing else.

    Its manifest goes first: what is left half-way belongs to none. That of a log goes last: it tells whose frames they
    are.
    """
    logs = [path for path in output.iterdir() if (path / MANIFEST).exists()]
    for name in (MANIFEST, "config.yaml"):
        with suppress(FileNotFoundError):
            (output / name).unlink()
    for folder in logs:
        for file in sorted(folder.iterdir(), key=lambda file: file.name == MANIFEST):
            if _OURS.fullmatch(file.name):
                file.unlink()
        with suppress(OSError):  # something else is left in it; object stores have no folders
            folder.rmdir()


def _read(file: Path) -> dict[str, Any] | None:
    try:
        content = read_json(file)
        if not isinstance(content, dict):
            raise CFlowError("no dictionary")
    except FileNotFoundError:
        return None
    except CFlowError as error:
        raise CFlowError(f"{file} is no manifest ({error}): remove it, or {_REMEDY}") from None
    return content


def _text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=1, sort_keys=True) + "\n"
