"""What Hydra checks of the settings: presets and schemas of the group `model`, and the types of what commands take.

Importing this module registers them. A default and its help stand in cflow_torch/config.py (the method) or in a file of
configs/ (all else); here are types only. A preset of a user's own is a file model/mine.yaml in a folder of his own:

    defaults: [base_verified, _self_]  # or base_dense, base_keypoints
    num_history: 3                     # what it changes

and `cflow eval --config-dir FOLDER model=mine` takes it.
"""

from __future__ import annotations

from dataclasses import make_dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from cflow_torch.cli.choices import CONFIGS, SETTERS, files, groups, own_settings
from cflow_torch.config import CONFIGS as METHODS
from cflow_torch.config import PRESETS, Config, make_config

# A name has one type in all commands; one that is not here takes any value.
_TYPES: Dict[str, Any] = {
    "archive": Optional[str],
    "batches": List[int],
    "cluster": Optional[int],
    "count": Optional[int],
    "definition": str,
    "dry_run": bool,
    "experiment_name": Optional[str],
    "first": int,
    "flow": Optional[str],
    "format": str,
    "frames": Optional[str],
    "frames_per_second": float,
    "legend": str,
    "log": Optional[str],
    "masks": Optional[str],
    "max_flow": Optional[float],
    "num_threads": Optional[int],
    "output": str,
    "overwrite": bool,
    "pair": int,
    "pairs": int,
    "picture": str,
    "repeats": int,
    "residual_axes": str,
    "result_name": Optional[str],
    "resume": bool,
    "show": bool,
    "step": int,
    "width": int,
}


def _schema(file: Path, *bases: type) -> type:
    names = {name.partition(".")[0] for name in own_settings(file)}
    if not bases:
        names.update(group for group in groups(file.stem) if group not in SETTERS)
    return make_dataclass(file.stem, [(name, _TYPES.get(name, Any), MISSING) for name in sorted(names)], bases=bases)


def _node(config: Config) -> Any:
    """A node whose fields can be overridden, unlike those of a frozen dataclass."""
    node = OmegaConf.structured(config)
    OmegaConf.set_readonly(node, None)
    return node


def _register() -> None:
    store = ConfigStore.instance().store
    for method, kind in METHODS.items():
        store(f"base_{method}", _node(kind()), "model")
    for preset in PRESETS:
        store(preset, _node(make_config(preset)), "model")
    for file in CONFIGS.glob("*.yaml"):
        if file.stem != "hydra":
            store(f"base_{file.stem}", _schema(file))
    plot = _schema(CONFIGS / "plot.yaml")
    for file in files("picture"):
        store(f"base_{file.stem}", _schema(file, plot), "picture", package="_global_")


_register()
