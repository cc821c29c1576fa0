"""Write pseudo-labels into OpenSceneFlow's scenes: `cflow label`."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path
from typing import Any

from tqdm import tqdm

from cflow_torch.applications.labels import find_labels
from cflow_torch.cli.commands import Label
from cflow_torch.cli.failures import Failures, collect_failures
from cflow_torch.cli.flow_run import FlowRun
from cflow_torch.cli.stored_flow import stored_flow
from cflow_torch.data.hdf5.writer import check_writable, labelled_by, write_hdf5_labels
from cflow_torch.errors import import_optional
from cflow_torch.estimate import make_model
from cflow_torch.fleet.machine import choose_devices
from cflow_torch.fleet.manifest import complete_frames
from cflow_torch.types import CFlowError


def task(cfg: Label) -> None:
    run = FlowRun(cfg, _contents(cfg), redo=False)  # the same settings give the same labels
    run.done = frozenset(scene for scene in run.logs.sources if _maker(scene) == run.job.identity["hash"])
    if cfg.dry_run:
        print(run.forecast())
        return
    _check(cfg, run)
    report = run.compute()
    failures = [] if report["stopped_by"] else _label(cfg, run, report)
    file = run.logs.sources[0].parent / f"cflow_label-{run.shard.index}-of-{run.shard.count}.json"
    run.finish(report, failures, file)


def _contents(cfg: Label) -> tuple[str, ...]:
    """Return the columns that labels need, or reject settings that give no labels."""
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("labels are written into HDF5 scenes of OpenSceneFlow: give their folder, and leave data= out")
    if cfg.model.method != "verified":
        raise CFlowError("labels need the confidence of the flow: give model=offline or default")
    import_optional("scipy.spatial", "labels need SciPy (extra label): pip install scipy")
    return "residual", "cluster_id", "confidence"


def _check(cfg: Label, run: FlowRun) -> None:
    for scene in run.logs.sources:
        check_writable(scene)
        if _maker(scene) not in (None, run.job.identity["hash"]) and not cfg.overwrite:
            why = "labels of other settings or of another program"
            raise CFlowError(f"{scene} has {why}: give overwrite=true, or label a copy")


def _maker(scene: Path) -> str | None:
    """Return how the labels of a scene were made, None = it has no labels."""
    with suppress(CFlowError):  # a scene that cannot be read is reported later
        return labelled_by(scene)
    return None


def _label(cfg: Label, run: FlowRun, report: dict[str, Any]) -> Failures:
    """Label the scenes of a shard whose flow is complete, and list them in the report.

    A scene that cannot be written stays as it was.
    """
    failures: Failures = []
    labelled: list[str] = []
    waiting: list[str] = []
    model = make_model(cfg.model, cfg.device)
    stored = stored_flow(run.output, ())
    workers = len(choose_devices(cfg.device, cfg.engine.workers, os.environ))
    scenes = [part.source for part in run.parts]
    for scene in tqdm(scenes, desc="labels", unit="scene", disable=None):
        folder = run.output / scene.stem
        with collect_failures(failures, scene.stem):
            if labelled_by(scene) == run.job.identity["hash"]:  # by another shard
                continue
            log = run.logs.open(scene)
            if not {int(log.timestamps[index]) for index in log.pairs} <= complete_frames(folder):
                waiting.append(scene.name)  # failed frames are in the report; others belong to another shard
                continue
            flows = (stored(log, index) for index in log.pairs)
            labels = find_labels(log, flows, model, workers)
            write_hdf5_labels(scene, labels, run.job.identity["hash"], overwrite=cfg.overwrite)
            labelled.append(scene.name)
    print(f"scenes labelled: {len(labelled)}, scenes without complete flow yet: {len(waiting)}")
    report.update(labelled=labelled, without_flow=waiting)
    return failures
