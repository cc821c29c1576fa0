"""One flow file per pair of consecutive sweeps: OUTPUT/<log id>/<time stamp of sweep t>.feather.

Columns: flow_t{x,y,z}_m total flow, residual_t{x,y,z}_m motion of objects, pose_t{x,y,z}_m ego motion (float32,
metres until the next sweep, axes of the ego frame at t+1), cluster_id, score, is_valid; one row per point of sweep t.
OUTPUT/config.yaml holds the resolved settings and versions. result_name=NAME (HDF5 scenes) also writes the total flow
into the scenes themselves, as key NAME of every sweep, where the viewers of OpenSceneFlow find it.

  cflow flow data=av2 data.root=/data/av2/val output=outputs/val
  cflow flow model=paper model.pixel_sizes=[0.2]
  cflow flow data=hdf5 data.root=/data/scenes result_name=cflow
"""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any, List, Tuple

from omegaconf import DictConfig
from tqdm import tqdm

from cflow_torch.cli.run import Failures, finish, for_each_pair, make_model, open_logs, output_folder, write_config
from cflow_torch.data.flow_file import read_flow, write_flow
from cflow_torch.data.hdf5.reader import HDF5Log
from cflow_torch.data.hdf5.results import check_result_name, check_writable, write_hdf5_results
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError, FlowResult, Window


def task(cfg: DictConfig) -> None:
    """Run `cflow flow`."""
    output = output_folder(cfg)
    if (output / "config.yaml").exists() and not cfg.overwrite:
        raise CFlowError(f"{output} holds results of another run: give output=FOLDER, or overwrite=true")
    if cfg.result_name is not None:
        if cfg.data.name != "hdf5":
            raise CFlowError(f"result_name writes into HDF5 scenes: it needs data=hdf5, not data={cfg.data.name}")
        check_result_name(cfg.result_name)
    model = make_model(cfg)
    logs, failures = open_logs(cfg, output)
    done: List[Tuple[Log, int, Path]] = []
    with ExitStack() as scenes:  # closed before anything is written into them
        for log in logs:
            scene = _scene(log)
            if isinstance(scene, HDF5Log):
                scenes.enter_context(scene)
                if cfg.result_name is not None:
                    check_writable(scene.file)
        write_config(cfg, output)

        def keep(log: Log, index: int, _: Window, result: FlowResult) -> None:
            file = output / log.log_id / f"{log.timestamps[index]}.feather"
            write_flow(file, result)
            done.append((log, log.timestamps[index], file))

        failures += for_each_pair(logs, model, keep)
    print(f"flow files in {output}")
    if cfg.result_name is not None:
        failures += _into_scenes(cfg.result_name, logs, done)
    finish(failures)


def _into_scenes(name: str, logs: List[Log], done: List[Tuple[Log, int, Path]]) -> Failures:
    """Copy the flow files of this run into their scenes; a scene that refuses is reported and left as it was."""
    failures: Failures = []
    count = 0
    for log in tqdm(logs, desc=name, unit="scene", disable=None):
        results = ((timestamp, read_flow(file).flow) for owner, timestamp, file in done if owner is log)
        try:
            count += write_hdf5_results(_scene(log).file, name, results)
        except (CFlowError, OSError) as error:
            failures.append((log.log_id, str(error)))
    print(f"sweeps that now have a key {name} in their scene: {count} (the last sweep of a scene has no flow)")
    return failures


def _scene(log: Any) -> Any:
    """The log itself, without what was put round it (ground, poses)."""
    return _scene(log.log) if hasattr(log, "log") else log
