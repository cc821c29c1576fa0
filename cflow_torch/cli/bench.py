"""Times the method against its targets, its reference and a plain OpenCV loop: tables and OUTPUT/bench.json.

One window of the first log, all on the same data in the same run, medians; times of one stage after the other,
windows per second in batches, memory. Other work on the machine spoils the figures.

examples:
  cflow bench                                                    a simulated street
  cflow bench data=av2 data.root=/data/av2/val/LOG repeats=50    real data, more runs
  cflow bench num_threads=1 opencv=false                         one core; without the OpenCV loop
"""

from __future__ import annotations

import json
from dataclasses import asdict

from omegaconf import DictConfig, OmegaConf

from cflow_torch.bench.measure import run_bench
from cflow_torch.bench.table import format_bench, format_targets
from cflow_torch.bench.target_row import FULL
from cflow_torch.bench.targets import measure_targets
from cflow_torch.cli.run import finish, make_model, number, open_logs
from cflow_torch.data.atomic import ready_folder
from cflow_torch.data.log import window
from cflow_torch.data.paths import as_path
from cflow_torch.data.records import write_text
from cflow_torch.types import CFlowError


def task(cfg: DictConfig) -> None:
    """Run `cflow bench`."""
    output = as_path(cfg.output)
    repeats, num_threads = number(cfg, "repeats"), number(cfg, "num_threads", or_null=True)
    if not OmegaConf.is_list(cfg.batches) or not all(type(batch) is int and batch > 0 for batch in cfg.batches):
        raise CFlowError(f"batches={cfg.batches}: give a list of whole numbers of at least 1, as in 'batches=[1,8]'")
    model = make_model(cfg)
    logs, failures = open_logs(cfg)
    finish(failures)
    ready_folder(output)
    config, log = model.config, logs[0]
    history, scales = FULL.num_history, FULL.pixel_sizes
    longest = len(log.timestamps) - 2
    index = min(max(history, config.num_history), longest)
    configs = {
        "as configured": config,
        "twice the region": config.replace(point_cloud_range=[2 * bound for bound in config.point_cloud_range]),
    }
    if config.method == "dense" and longest >= history:
        configs[f"h = {history}"] = config.replace(num_history=history)
        configs[f"h = {history}, {len(scales)} scales"] = config.replace(num_history=history, pixel_sizes=scales)
    elif config.method == "dense":
        print(f"log {log.log_id} has {longest + 2} sweeps: rows with h = {history} need {history + 2}")
    sweeps = window(log, index, max(history, config.num_history))
    settings = {"repeats": repeats, "num_threads": num_threads, "device": cfg.device}
    result = run_bench([sweeps], configs, with_reference=cfg.reference, with_opencv=cfg.opencv, **settings)
    print(format_bench(result))
    targets = measure_targets(
        sweeps, result, batches=cfg.batches, with_opencv=cfg.opencv, with_hdbscan=cfg.hdbscan, **settings
    )
    print("\n" + format_targets(targets))
    result["targets"] = [asdict(row) for row in targets]
    write_text(output / "bench.json", json.dumps(result, indent=2) + "\n")
    print(f"written to {output / 'bench.json'}")
