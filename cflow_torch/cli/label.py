"""Labels for self-supervised training, into OpenSceneFlow's HDF5 scenes: what SeFlow, SeFlow++ and TeFlow train with.

Each sweep gets dufo (moves), dufocluster, cluster and nnd, and a ground_mask where it has none, in the types and
meanings of the harness's own recipe. They follow from flow, which is estimated first, as `cflow flow` does, into
OUTPUT; by the preset offline, that is with sweeps before and after. Then each scene is copied, labelled and replaced:
it is the old one or the new one at any time. The same command again resumes; scenes that are labelled are left alone.
OUTPUT may be removed when all scenes are.

With shards, the process that finishes a scene's flow labels it. It ends with the statuses of `cflow flow`.

examples:
  cflow label /data/scenes/train
  cflow label /data/scenes/train dry_run=true                 counts the frames
  cflow label /data/scenes/train model=fast                   four to seven times faster, finds less
  cflow label /data/scenes/train shard.index=2 shard.count=16
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from omegaconf import DictConfig
from tqdm import tqdm

from cflow_torch.applications.labels import find_labels
from cflow_torch.cli import run
from cflow_torch.cli.flow import FlowRun, compute, finish
from cflow_torch.cli.run import Failures, Sources
from cflow_torch.data.flow_file import read_flow
from cflow_torch.data.hdf5.results import check_writable, labelled_by, write_hdf5_labels
from cflow_torch.data.paths import as_path
from cflow_torch.estimate import make_model
from cflow_torch.fleet.job import Job, Shard, find_shard
from cflow_torch.fleet.machine import choose_layout
from cflow_torch.fleet.manifest import complete_frames, frame_file
from cflow_torch.types import CFlowError

_CONTENTS = ("residual", "cluster_id", "confidence")


def task(cfg: DictConfig) -> None:
    """Run `cflow label`."""
    if cfg.data.get("name") != "hdf5":
        raise CFlowError("labels are for HDF5 scenes of OpenSceneFlow: give their folder, and no data=")
    if cfg.model.method != "verified":
        raise CFlowError("labels need the confidence of a flow: give model=offline, default or fast")
    shard = find_shard(cfg.shard.index, cfg.shard.count, os.environ)

    def check(job: Job, sources: Sources) -> None:
        for scene in sources.logs:
            check_writable(scene)
            maker = None
            with suppress(CFlowError):  # a scene that cannot be read is reported when its turn comes
                maker = labelled_by(scene)
            _check_maker(scene, maker, job)

    done = compute(cfg, shard, _CONTENTS, check)
    if done is not None:
        finish(done, shard, _label(done, shard, cfg) if done.report["stopped_by"] is None else [])


def _label(done: FlowRun, shard: Shard, cfg: DictConfig) -> Failures:
    """Label the scenes of a shard whose flow is complete; one that refuses is reported and left as it was."""
    failures: Failures = []
    model, count, waiting = make_model(done.job.config, cfg.device), 0, 0
    workers = len(choose_layout(cfg.device, cfg.engine.workers, 1, os.environ).devices)
    scenes = [unit.source for unit in shard.units(done.sources.logs)]
    for scene in tqdm(scenes, desc="labels", unit="scene", disable=None):
        folder = as_path(done.job.output) / scene.stem
        with run.collect_failures(failures, scene.stem):
            maker = labelled_by(scene)
            _check_maker(scene, maker, done.job)
            if maker == done.job.identity and not done.job.redo:
                continue
            log = done.sources.open(scene)
            stamps = log.timestamps[:-1]
            if not set(stamps) <= complete_frames(folder):
                waiting += 1  # frames that failed are in the report; others belong to another shard
                continue
            flows = (read_flow(frame_file(folder, stamp)) for stamp in stamps)
            labels = find_labels(log, flows, model, workers)
            write_hdf5_labels(scene, labels, done.job.identity, overwrite=done.job.redo)
            count += 1
    print(f"scenes labelled: {count}, left to other shards or without complete flow: {waiting}")
    return failures


def _check_maker(scene: Path, maker: str | None, job: Job) -> None:
    """Refuse a scene with labels that are not this run's, unless they are to be replaced."""
    if maker not in (None, job.identity) and not job.redo:
        raise CFlowError(
            f"{scene} has labels of other settings or of another program: overwrite=true replaces them, or label a copy"
        )
