"""Compose the settings of a command once for each choice of files: most calls of a process choose the same ones.

The words of a call change single values only after that, so each call gets its own copy. Without this, Hydra composes
for 50 ms in each call, mostly to copy what no call changes.
"""

from __future__ import annotations

import copy
import pickle
from typing import Any

import pytest
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository

_READ: dict[Any, Any] = {}  # files, of which Hydra changes nothing while it finds out which ones it needs
_COMPOSED: dict[Any, bytes] = {}
_LOAD, _COMPOSE = ConfigRepository.load_config, ConfigLoaderImpl._compose_config_from_defaults_list


def compose_once(patch: pytest.MonkeyPatch) -> None:
    """Let Hydra keep what it reads and composes. The files must not change: give none of your own."""
    patch.setattr(CachingConfigRepository, "__init__", _share_sources)
    patch.setattr(ConfigRepository, "load_config", _load)
    patch.setattr(ConfigLoaderImpl, "_compose_config_from_defaults_list", _compose)


def _share_sources(self: Any, delegate: Any) -> None:
    """Make a repository without a deep copy of all registered settings."""
    self.delegate, self.cache = copy.copy(delegate), {}


def _key(repository: Any, *of: Any) -> tuple[Any, ...]:
    return (*((source.provider, source.path) for source in repository.get_sources()), *of)


def _load(self: Any, config_path: str) -> Any:
    key = _key(self, config_path)
    if key not in _READ:
        _READ[key] = _LOAD(self, config_path)
    return _READ[key]


def _compose(self: Any, defaults: Any, repo: Any) -> Any:
    key = _key(repo, *map(repr, defaults))
    if key not in _COMPOSED:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ConfigRepository, "load_config", _LOAD)  # composing changes what was read
            _COMPOSED[key] = pickle.dumps(_COMPOSE(self, defaults, CachingConfigRepository(self.repository)))
    return pickle.loads(_COMPOSED[key])
