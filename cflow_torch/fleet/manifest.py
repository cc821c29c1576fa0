"""The files in an output folder, and the manifests that keep results of different settings or inputs apart.

OUTPUT/<log id>/manifest.json     identity of the run: method, data settings, contents, versions; time stamps of the
                                  log, and digests of its first, middle and last sweep
OUTPUT/<log id>/<ns>.feather      a frame; its file gets this name when it is complete
OUTPUT/<log id>/tracks.parquet    moving objects of a log whose frames are all complete; next to it the files of tracks=
OUTPUT/<log id>/masks/<camera>/<image>.png             masks of dynamic objects of such a log
OUTPUT/<log id>/dynamic_masks/<kind>/<frame>_<C>.png   those for DriveStudio
OUTPUT/sequences/<log id>/predictions/<sweep>.label    moving points of such a log
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Container, Iterable, Mapping, Sequence

import numpy as np
import torch

from cflow_torch import __version__
from cflow_torch.config import Config
from cflow_torch.data.flow_file import CONTENTS
from cflow_torch.data.json_file import json_ready, read_json, write_json
from cflow_torch.data.log import Log
from cflow_torch.data.paths import forget_listings, is_remote, remote_errors
from cflow_torch.fleet.changes import OVERWRITE, check_same_run
from cflow_torch.setting import free_settings
from cflow_torch.types import CFlowError, as_numpy

MANIFEST = "manifest.json"
_FORMAT = 2
_FRAME = re.compile(r"[0-9]{1,20}\.feather")
_ENDING = b"ARROW1"  # last bytes of a feather file
_OURS = re.compile(r"[0-9]+\.feather|manifest\.json|\..+\.tmp")
_LABELS = re.compile(r"[0-9]{6}\.label|\..+\.tmp")


def versions() -> dict[str, str]:
    """Return the versions on which results depend. CPU and CUDA builds of one torch version count as the same."""
    return {
        "cflow_torch": __version__,
        "torch": str(torch.__version__).split("+")[0],
        "numpy": np.__version__,
    }


def make_identity(
    config: Config, reader: str, settings: Mapping[str, Any], contents: Sequence[str] = CONTENTS
) -> dict[str, Any]:
    """Return what determines a result besides the sweeps: method, data settings, contents of files, versions."""
    data = {"reader": reader, **{key: value for key, value in settings.items() if key != "check"}}
    free = free_settings(type(config))
    method = {key: value for key, value in asdict(config).items() if key not in free}
    identity = json_ready(
        {"format": _FORMAT, "method": method, "data": data, "contents": contents, "versions": versions()}
    )
    text = json.dumps(identity, indent=1, sort_keys=True) + "\n"
    return {**identity, "hash": hashlib.sha256(text.encode()).hexdigest()}


def check_logs(output: Path, names: Iterable[str], identity: Mapping[str, Any], overwrite: bool, alone: bool) -> None:
    """Raise a `CFlowError` if results of a run must not be added to the folders of logs in `output`.

    A run continues an earlier one of the same identity. `overwrite` replaces the results of other runs. It is allowed
    only if you are `alone`, that is, if no other shard works on these logs. A worker checks a log again when it
    has opened it (`checked_manifest`). An object store takes a while for each log, so there we leave it to the workers.
    """
    forget_listings(output)
    if is_remote(output):
        return
    for folder in (output / name for name in names):
        before = _read(folder)
        if before is None or (overwrite and alone) or not complete_frames(folder):
            continue
        remedy = "remove that folder" if overwrite else OVERWRITE
        check_same_run(folder, before.get("run", {}), identity, ["hash"], remedy)


def checked_manifest(folder: Path, log: Log, identity: Mapping[str, Any]) -> dict[str, Any]:
    """Make sure that the frames in a log's folder were computed from this log, and return its manifest.

    A log that has changed since, or another log of its name, is a `CFlowError`. Cost: reads three sweeps.
    """
    manifest = {"run": dict(identity), **describe_log(log)}
    _is_claimed(folder, manifest)
    return manifest


def claim_log(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Write the manifest of `checked_manifest`, unless there is one. Call this before the first frame is written."""
    if not _is_claimed(folder, manifest):
        write_json(folder / MANIFEST, manifest)
        _check_manifest(folder, _read(folder) or {}, manifest)  # another process may have been quicker


def is_of_run(folder: Path, identity: Mapping[str, Any]) -> bool:
    """Test whether a log's folder has results of the run with this identity."""
    return (_read(folder) or {}).get("run") == identity


def _is_claimed(folder: Path, manifest: Mapping[str, Any]) -> bool:
    """Test whether a folder has a manifest, which must be this one; one of another run without frames is replaced."""
    before = _read(folder)
    if before is None or (before.get("run") != manifest["run"] and not complete_frames(folder)):
        return False
    _check_manifest(folder, before, manifest)
    return True


def _check_manifest(folder: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    check_same_run(folder, before.get("run", {}), now["run"], ["hash"])
    if not are_of_same_log(before, now):
        raise CFlowError(
            f"{folder} has flow of other sweeps (the log has changed since, or two logs have the same name): "
            "remove that folder, or give output=FOLDER"
        )


def describe_log(log: Log) -> dict[str, Any]:
    """Describe a log: its id, its time stamps, and digests of its first, middle and last sweep.

    A sweep that cannot be read has no digest; its frames fail later.
    """
    stamps = [int(stamp) for stamp in log.timestamps]
    digests = {}
    for index in sorted({0, len(stamps) // 2, len(stamps) - 1} & set(range(len(stamps)))):
        with suppress(CFlowError, OSError):
            digests[str(stamps[index])] = _digest(log, index)
    return {"log_id": log.log_id, "timestamps": stamps, "sweeps": digests}


def are_of_same_log(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Test whether two results of `describe_log` have the same id, times, and digests of the sweeps that both have."""
    digests = before.get("sweeps") or {}
    both = now["sweeps"].keys() & digests.keys()
    is_same = all(before.get(key) == now[key] for key in ("log_id", "timestamps"))
    return is_same and all(digests[key] == now["sweeps"][key] for key in both)


def clear_log(folder: Path, tracks: Container[str] = ()) -> None:
    """Remove the results of a log, also the files called `tracks`, and no other files.

    We remove the manifest last, because it marks the folder as ours.
    """
    if _read(folder) is None:
        return
    labels = labels_folder(folder.parent, folder.name)
    for file in labels.iterdir() if labels.is_dir() else ():
        if _LABELS.fullmatch(file.name):
            file.unlink()
    for masks_of in (masks_folder, drivestudio_masks_folder):
        masks = masks_of(folder.parent, folder.name)
        for camera in masks.iterdir() if masks.is_dir() else ():
            for file in camera.glob("*.png"):
                file.unlink()
            with suppress(OSError):
                camera.rmdir()
        with suppress(OSError):
            masks.rmdir()
    for file in sorted(folder.iterdir(), key=lambda file: file.name == MANIFEST):
        if _OURS.fullmatch(file.name) or file.name in tracks:
            file.unlink()
    with suppress(OSError):  # it has other files, or an object store has no folders
        folder.rmdir()


def complete_frames(folder: Path) -> set[int]:
    """Return the time stamps of the complete frames in a log's folder. Cost: reads the last bytes of every local file.

    Files without the log's manifest do not count, because their input is unknown. Incomplete files, such as those of an
    interrupted copy, do not count either.
    """
    names = _names(folder)
    if MANIFEST not in names:
        return set()
    whole = [name for name in names if _FRAME.fullmatch(name) and (is_remote(folder) or _is_whole(folder / name))]
    return {int(name[: -len(".feather")]) for name in whole}


def _names(folder: Path) -> list[str]:
    """Return the names of the files in a folder, none if there is no folder."""
    forget_listings(folder)
    with remote_errors(folder):
        return [file.name for file in folder.iterdir()] if folder.is_dir() else []


def frame_file(folder: Path, timestamp: int) -> Path:
    return folder / f"{timestamp}.feather"


def labels_folder(output: Path, log_id: str) -> Path:
    """Return the folder of a log's labels, as evaluators of SemanticKITTI expect it below `output`."""
    return output / "sequences" / log_id / "predictions"


def masks_folder(output: Path, log_id: str) -> Path:
    """Return the folder of the masks of a log's images, which has a folder for each camera."""
    return output / log_id / "masks"


def drivestudio_masks_folder(output: Path, log_id: str) -> Path:
    """Return the folder of the masks of a log's images for DriveStudio, which has a folder for each kind."""
    return output / log_id / "dynamic_masks"


def _is_whole(file: Path) -> bool:
    with suppress(OSError), open(file, "rb") as opened:
        opened.seek(-len(_ENDING), os.SEEK_END)
        return opened.read() == _ENDING
    return False


def _digest(log: Log, index: int) -> str:
    """Hash what the method uses of a sweep."""
    sweep, digest = log.sweep(index), hashlib.sha256()
    for values in (sweep.points, sweep.is_ground, sweep.pose):
        digest.update(b"none" if values is None else as_numpy(values).tobytes())
    return digest.hexdigest()


def _read(folder: Path) -> dict[str, Any] | None:
    """Read the manifest of a log's folder; None = the folder has neither a manifest nor frames.

    Frames without a manifest, and a manifest of others, are a `CFlowError`: we neither replace nor remove them.
    """
    # We list the frames first: another process of this run writes its manifest before them.
    has_frames = any(map(_FRAME.fullmatch, _names(folder)))
    try:
        manifest = read_json(folder / MANIFEST)
        if "cflow_torch" in manifest["run"]["versions"]:
            return manifest  # type: ignore[no-any-return]
    except FileNotFoundError:
        if not has_frames:
            return None
    except (CFlowError, LookupError, TypeError):
        pass  # whatever a file of others holds
    raise CFlowError(f"{folder} has files that no {MANIFEST} of cflow describes: give output=FOLDER")
