"""Times the method, stage by stage, against the reference and a plain OpenCV loop: a table and OUTPUT/bench.json.

cflow bench
cflow bench data=av2 data.root=/data/av2/val/LOG repeats=50
"""

from __future__ import annotations

import json
from pathlib import Path

from omegaconf import DictConfig

from cflow_torch.bench.measure import format_bench, run_bench
from cflow_torch.cli.run import finish, make_model, open_logs, write_text
from cflow_torch.data.log import window


def task(cfg: DictConfig) -> None:
    """Run `cflow bench`."""
    output = Path(cfg.output)
    model = make_model(cfg)
    logs, failures = open_logs(cfg, output)
    finish(failures)
    config = model.config
    index = min(config.num_history, len(logs[0].timestamps) - 2)
    wide = config.replace(point_cloud_range=[2 * bound for bound in config.point_cloud_range])
    result = run_bench(
        [window(logs[0], index, config.num_history)],
        {"+-35 m": config, "+-70 m": wide},
        repeats=cfg.repeats,
        with_reference=cfg.reference,
        with_opencv=cfg.opencv,
        num_threads=cfg.num_threads,
    )
    write_text(output / "bench.json", json.dumps(result, indent=2) + "\n")
    print(format_bench(result))
    print(f"written to {output / 'bench.json'}")
