"""Register the presets and the types of the settings of the methods with Hydra, when this module is imported.

Your own preset is a file FOLDER/model/mine.yaml, used by `cflow eval --config-dir FOLDER model=mine`:

    defaults: [base_verified, _self_]  # or base_dense, base_keypoints
    num_history: 3                     # the changes
"""

from __future__ import annotations

from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from cflow_torch.config import CONFIGS, PRESETS, Config, make_config


def _node(config: Config) -> Any:
    """A node of a frozen dataclass whose fields can be overridden."""
    node = OmegaConf.structured(config)
    OmegaConf.set_readonly(node, None)
    return node


for _method, _kind in CONFIGS.items():
    ConfigStore.instance().store(f"base_{_method}", _node(_kind()), "model")
for _preset in PRESETS:
    ConfigStore.instance().store(_preset, _node(make_config(_preset)), "model")
