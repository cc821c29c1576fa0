"""What Hydra checks of the settings: presets and schemas of the group `model`, and the types of what commands take.

Importing this module registers them. A default and its help stand in cflow_torch/config.py (the method) or in a file of
configs/ (all else); here are types only. A preset of a user's own is a file model/mine.yaml in a folder of his own:

    defaults: [base_verified, _self_]  # or base_dense, base_keypoints
    num_history: 3                     # what it changes

and `cflow eval --config-dir FOLDER model=mine` takes it.
"""

from __future__ import annotations

from dataclasses import make_dataclass
from typing import Any, Dict, Optional

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from cflow_torch.config import CONFIGS, PRESETS, Config, make_config

_ALL = {"output": str, "device": Any, "model": Any, "data": Any}
COMMANDS: Dict[str, Dict[str, Any]] = {
    "demo": {"definition": str, "pair": int},
    "eval": {"definition": str, "overwrite": bool, "experiment_name": Optional[str]},
    "flow": {
        "engine": Any,
        "resume": bool,
        "overwrite": bool,
        "dry_run": bool,
        "shard": make_dataclass("Shard", [(name, Any, MISSING) for name in ("index", "count")]),
        "contents": Any,
        "result_name": Optional[str],
    },
    "submit": {
        "version": Any,
        "archive": Optional[str],
        "frames": Optional[str],
        "masks": Optional[str],
        "residual_axes": str,
        "overwrite": bool,
    },
    "view": {"flow": Optional[str], "count": Optional[int], "max_flow": Optional[float], "show": bool},
    "plot": {"log": Optional[str], "pair": int, "picture": str},
}
# What a picture adds to the settings of `cflow plot`.
PICTURES: Dict[str, Dict[str, Any]] = {
    "flow": {"truth": Any, "max_flow": Optional[float]},
    "correlation": {"cluster": Optional[int]},
    "animation": {
        "first": int,
        "step": int,
        "count": Optional[int],
        "format": str,
        "frames_per_second": float,
        "width": int,
        "max_flow": Optional[float],
        "legend": str,
    },
}


def _schema(name: str, types: Dict[str, Any], *bases: type) -> type:
    return make_dataclass(name, [(key, kind, MISSING) for key, kind in types.items()], bases=bases)


def _node(config: Config) -> Any:
    """A node whose fields can be overridden, unlike those of a frozen dataclass."""
    node = OmegaConf.structured(config)
    OmegaConf.set_readonly(node, None)
    return node


def _register() -> None:
    store = ConfigStore.instance().store
    for method, kind in CONFIGS.items():
        store(f"base_{method}", _node(kind()), "model")
    for preset in PRESETS:
        store(preset, _node(make_config(preset)), "model")
    schemas = {name: _schema(name, {**_ALL, **types}) for name, types in COMMANDS.items()}
    for name, schema in schemas.items():
        store(f"base_{name}", schema)
    for name, types in PICTURES.items():
        store(f"base_{name}", _schema(name, types, schemas["plot"]), "picture", package="_global_")


_register()
