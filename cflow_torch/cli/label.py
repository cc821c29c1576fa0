"""Writes pseudo-labels into OpenSceneFlow's HDF5 scenes, for the training of SeFlow, SeFlow++ and TeFlow.

Each sweep gets the keys dufo (dynamic), dufocluster, cluster and nnd. It gets ground_mask if it has none. Types and
meanings are those of OpenSceneFlow's own scripts. First, the command estimates the flow like `cflow flow`, with the
preset offline, which uses earlier and later sweeps. Then each scene is copied, labelled and replaced, so a killed run
leaves the old scene or the new one. Run the command again to resume; labelled scenes are skipped. The report,
cflow_label-0-of-1.json, is next to the scenes. You can delete OUTPUT when all scenes are labelled. With shards,
the process that completes the flow of a scene labels it. The exit statuses are those of `cflow flow`.

examples:
  cflow label /data/scenes/train
  cflow label /data/scenes/train dry_run=true                 counts the frames
  cflow label /data/scenes/train model=default                half the time, finds fewer people
  cflow label /data/scenes/train shard.index=2 shard.count=16
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import Any

from omegaconf import DictConfig
from tqdm import tqdm

from cflow_torch.applications.labels import find_labels
from cflow_torch.cli import run
from cflow_torch.cli.flow import FlowRun, compute
from cflow_torch.cli.run import Failures
from cflow_torch.data.files import write_json
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.hdf5.writer import check_writable, labelled_by, write_hdf5_labels
from cflow_torch.data.paths import as_path
from cflow_torch.fleet.machine import choose_layout
from cflow_torch.fleet.manifest import complete_frames, frame_file
from cflow_torch.types import CFlowError

_CONTENTS = ("residual", "cluster_id", "confidence")


def task(cfg: DictConfig) -> None:
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("labels are written into HDF5 scenes of OpenSceneFlow: give their folder, and leave data= out")
    if cfg.model.method != "verified":
        raise CFlowError("labels need the confidence of the flow: give model=offline or default")
    compute(cfg, _CONTENTS, _check, _label)


def _check(cfg: DictConfig, flow: FlowRun) -> None:
    for scene in flow.sources.logs:
        check_writable(scene)
        maker = None
        with suppress(CFlowError):  # a scene that cannot be read is reported later
            maker = labelled_by(scene)
        if maker not in (None, flow.job.identity) and not cfg.overwrite:
            why = "labels of other settings or of another program"
            raise CFlowError(f"{scene} has {why}: give overwrite=true, or label a copy")


def _label(cfg: DictConfig, flow: FlowRun, report: dict[str, Any]) -> Failures:
    """Label the scenes of a shard whose flow is complete. If one cannot be written, it stays as it was."""
    failures: Failures = []
    labelled: list[str] = []
    waiting: list[str] = []
    model = run.make_model(cfg)
    workers = len(choose_layout(cfg.device, cfg.engine.workers, 1, os.environ).devices)
    scenes = [part.source for part in flow.shard.parts(flow.sources.logs)]
    for scene in tqdm(scenes, desc="labels", unit="scene", disable=None):
        folder = as_path(flow.job.output) / scene.stem
        with run.collect_failures(failures, scene.stem):
            if labelled_by(scene) == flow.job.identity and not flow.job.redo:
                continue
            log = flow.sources.open(scene)
            stamps = log.timestamps[:-1]
            if not set(stamps) <= complete_frames(folder):
                waiting.append(scene.name)  # failed frames are in the report; others belong to another shard
                continue
            flows = (read_flow(frame_file(folder, stamp)) for stamp in stamps)
            labels = find_labels(log, flows, model, workers)
            write_hdf5_labels(scene, labels, flow.job.identity, overwrite=flow.job.redo)
            labelled.append(scene.name)
    print(f"scenes labelled: {len(labelled)}, scenes without complete flow yet: {len(waiting)}")
    file = scenes[0].parent / f"cflow_label-{flow.shard.index}-of-{flow.shard.count}.json"
    write_json(file, {**report, "labelled": labelled, "waiting": waiting, "not_labelled": failures})
    print(f"report: {file}")
    return failures
