"""Times the method, stage by stage, against the reference and a plain OpenCV loop: a table and OUTPUT/bench.json.

cflow bench
cflow bench data=av2 data.root=/data/av2/val/LOG repeats=50
"""

from __future__ import annotations

import json
from pathlib import Path

from omegaconf import DictConfig

from cflow_torch.bench.measure import run_bench
from cflow_torch.bench.table import format_bench
from cflow_torch.cli.run import finish, make_model, open_logs, write_text
from cflow_torch.data.log import window

# The full configuration of the paper's figure benefit_multiscale.
_FULL_HISTORY = 4
_FULL_SCALES = (0.8, 0.4, 0.3, 0.2, 0.1)


def task(cfg: DictConfig) -> None:
    """Run `cflow bench`."""
    output = Path(cfg.output)
    model = make_model(cfg)
    logs, failures = open_logs(cfg, output)
    finish(failures)
    config, log = model.config, logs[0]
    longest = len(log.timestamps) - 2
    index = min(max(_FULL_HISTORY, config.num_history), longest)
    configs = {
        "as configured": config,
        "twice the region": config.replace(point_cloud_range=[2 * bound for bound in config.point_cloud_range]),
    }
    if config.method == "dense" and longest >= _FULL_HISTORY:
        configs[f"h = {_FULL_HISTORY}"] = config.replace(num_history=_FULL_HISTORY)
        full = config.replace(num_history=_FULL_HISTORY, pixel_sizes=_FULL_SCALES)
        configs[f"h = {_FULL_HISTORY}, {len(_FULL_SCALES)} scales"] = full
    elif config.method == "dense":
        print(f"log {log.log_id} has {longest + 2} sweeps: rows with h = {_FULL_HISTORY} need {_FULL_HISTORY + 2}")
    result = run_bench(
        [window(log, index, _FULL_HISTORY)],
        configs,
        repeats=cfg.repeats,
        with_reference=cfg.reference,
        with_opencv=cfg.opencv,
        num_threads=cfg.num_threads,
        device=cfg.device,
    )
    write_text(output / "bench.json", json.dumps(result, indent=2) + "\n")
    print(format_bench(result))
    print(f"written to {output / 'bench.json'}")
