"""One flow file per pair of consecutive sweeps: OUTPUT/<log id>/<time stamp of sweep t>.feather.

Columns: flow_t{x,y,z}_m total flow, residual_t{x,y,z}_m motion of objects, pose_t{x,y,z}_m ego motion (float32,
metres until the next sweep, axes of the ego frame at t+1), cluster_id, score, is_valid; one row per point of sweep t.
OUTPUT/config.yaml holds the resolved settings and versions.

  cflow flow data=av2 data.root=/data/av2/val output=outputs/val
  cflow flow model=paper model.pixel_sizes=[0.2]
"""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from cflow_torch.cli.run import finish, for_each_pair, make_model, open_logs, write_config
from cflow_torch.data.flow_file import write_flow
from cflow_torch.data.log import Log
from cflow_torch.types import CFlowError, FlowResult, Window


def task(cfg: DictConfig) -> None:
    """Run `cflow flow`."""
    output = Path(cfg.output)
    if (output / "config.yaml").exists() and not cfg.overwrite:
        raise CFlowError(f"{output} holds results of another run: give output=FOLDER, or overwrite=true")
    model = make_model(cfg)
    logs, failures = open_logs(cfg, output)
    write_config(cfg, output)

    def keep(log: Log, index: int, _: Window, result: FlowResult) -> None:
        write_flow(output / log.log_id / f"{log.timestamps[index]}.feather", result)

    failures += for_each_pair(logs, model, keep)
    print(f"flow files in {output}")
    finish(failures)
