"""Register the presets and the types of all settings with Hydra, when this module is imported.

Defaults and explanations are in cflow_torch/config.py (settings of the method) and in configs/ (all others). Your own
preset is a file FOLDER/model/mine.yaml, used by `cflow eval --config-dir FOLDER model=mine`:

    defaults: [base_verified, _self_]  # or base_dense, base_keypoints
    num_history: 3                     # the changes
"""

from __future__ import annotations

from dataclasses import make_dataclass
from pathlib import Path
from typing import Any, List, Optional

from hydra.core.config_store import ConfigStore
from omegaconf import MISSING, OmegaConf

from cflow_torch.cli.choices import CONFIGS, SETTERS, files, groups, own_settings
from cflow_torch.config import CONFIGS as METHODS
from cflow_torch.config import PRESETS, Config, make_config

# A setting has the type of its default in configs/. If that is null, auto or a list, it takes any value. Others:
_TYPES: dict[str, Any] = {
    "batches": List[int],
    "cluster": Optional[int],
    "experiment_name": Optional[str],
    "max_flow": Optional[float],
    "pace": Optional[float],
    "pair": Optional[int],
    "tracks": Any,
}


def _schema(file: Path, *bases: type) -> type:
    types = {}
    for name, value in own_settings(file).items():
        any_value = value is None or value == "auto" or isinstance(value, list)
        types[name.partition(".")[0]] = _TYPES.get(name, Any if any_value else type(value))
    if not bases:
        types.update({group: Any for group in groups(file.stem) if group not in SETTERS})
    return make_dataclass(file.stem, [(name, kind, MISSING) for name, kind in types.items()], bases=bases)


def _node(config: Config) -> Any:
    """A node of a frozen dataclass whose fields can be overridden."""
    node = OmegaConf.structured(config)
    OmegaConf.set_readonly(node, None)
    return node


def _register() -> None:
    store = ConfigStore.instance().store
    for method, kind in METHODS.items():
        store(f"base_{method}", _node(kind()), "model")
    for preset in PRESETS:
        store(preset, _node(make_config(preset)), "model")
    schemas = {file.stem: _schema(file) for file in CONFIGS.glob("*.yaml") if file.stem != "hydra"}
    for name, schema in schemas.items():
        store(f"base_{name}", schema)
    for file in files("picture"):
        store(f"base_{file.stem}", _schema(file, schemas["plot"]), "picture", package="_global_")


_register()
