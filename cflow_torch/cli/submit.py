"""Write and check an archive for a public leaderboard: `cflow submit`."""

from __future__ import annotations

from pathlib import Path
from typing import Any, List, Mapping, Optional, Sequence, Tuple

from cflow_torch.cli.commands import Submit
from cflow_torch.cli.failures import Failures, collect_failures, finish
from cflow_torch.cli.logs import open_logs
from cflow_torch.cli.outputs import claim_output, local_folder
from cflow_torch.cli.pairs import for_each_pair
from cflow_torch.data.log import Log
from cflow_torch.estimate import make_model
from cflow_torch.evaluation.submission import archive, frames
from cflow_torch.evaluation.submission.archive import SubmissionVersion
from cflow_torch.evaluation.submission.frames import MaskArchive, SubmittedFrame
from cflow_torch.fleet.progress import Progress
from cflow_torch.model import SceneFlowModel
from cflow_torch.types import CFlowError, FlowResult, Window

Plan = List[Tuple[SubmittedFrame, int]]  # frames with their numbers of rows
_Masks = Optional[MaskArchive]
_Listed = Optional[Mapping[str, Sequence[str]]]


def task(cfg: Submit) -> None:
    version, output = archive.get_version(cfg.version), local_folder(cfg)
    if cfg.masks is not None and not version.is_masked:
        raise CFlowError(f"version {version.number} contains every point: masks= is only for version 1")
    if cfg.masks is not None and cfg.frames is not None:
        raise CFlowError("masks= already lists the frames that are evaluated: leave frames= out")
    masks = None if cfg.masks is None else MaskArchive(cfg.masks)
    listed = frames.read_frame_list(cfg.frames) if cfg.frames is not None else None if masks is None else masks.frames
    model = make_model(cfg.model, cfg.device)
    logs, failures = open_logs(cfg.data)
    plan, unreadable = _plan(logs, version, listed, masks)
    failures += unreadable
    if cfg.archive is not None:
        finish(failures)  # what the archive must contain is unknown if a log cannot be read
        _check(cfg.archive, version, plan)
        return
    folder, file = output / f"v{version.number}", output / f"v{version.number}.zip"
    claim_output(cfg, output, (folder, file))
    failures += _write(plan, model, version, masks, folder)
    finish(failures)
    _check(folder, version, plan)
    archive.write_zip(folder, [frame.name for frame, _ in plan], file)
    try:
        _check(file, version, plan)
    except BaseException:  # the archive stays only if it passes
        file.unlink()
        raise
    print(f"version {version.number}, for {version.server}: {file}, {file.stat().st_size:,} bytes")


def _plan(logs: Sequence[Log], version: SubmissionVersion, listed: _Listed, masks: _Masks) -> tuple[Plan, Failures]:
    """List the needed frames with their numbers of rows, and the frames whose sweep cannot be read."""
    frames.require_logs(logs, listed)
    wanted = [frame for log in logs for frame in frames.plan_log(log, listed)]
    if not wanted:
        raise CFlowError("there is no frame to submit: the logs are too short, or the list names none of their sweeps")
    if version.is_masked and masks is None and any(f.log.eval_mask(f.index) is None for f in wanted):
        print("no masks given: the official rule is applied, which can differ by a point from the server's masks")
    plan: Plan = []
    failures: Failures = []
    for frame in Progress(wanted, "rows"):
        with collect_failures(failures, frame.name):
            plan.append((frame, frame.count_rows(version, masks)))
    return plan, failures


def _write(plan: Plan, model: SceneFlowModel, version: SubmissionVersion, masks: _Masks, folder: Path) -> Failures:
    largest, total, count = 0.0, 0.0, 0
    todo = [frame for frame, rows in plan if not archive.is_complete(folder, frame.name, rows, version)]

    def write(log: Log, index: int, sweeps: Window, result: FlowResult) -> None:
        nonlocal largest, total, count
        mask = frames.point_mask(log, index, sweeps.pc0, masks) if version.is_masked else None
        columns, error = archive.encode(version, result, sweeps.pc0.is_ground, mask)
        archive.write_frame(folder, SubmittedFrame(log, index).name, columns)
        largest, total, count = max(largest, error.max(initial=0.0)), total + error.sum(), count + len(error)

    failures = for_each_pair([(frame.log, frame.index) for frame in todo], model, write)
    print(f"frames written: {len(todo) - len(failures)}, already there: {len(plan) - len(todo)}")
    if count:
        mean = total / count
        print(f"float16 rounding of the new ones: largest {largest:.6f} m, mean {mean:.8f} m over {count:,} points")
    return failures


def _check(path: Any, version: SubmissionVersion, plan: Plan) -> None:
    """Print what was checked. If there are problems, list them all and exit with status 1."""
    problems = archive.check_submission(path, version, {frame.name: rows for frame, rows in plan})
    finish([(str(path), problem) for problem in problems])
    rows = sum(rows for _, rows in plan)
    print(f"{path}: passes as version {version.number}, frames: {len(plan)}, rows: {rows:,}")
