"""Settings that an earlier run left as YAML: plain values, and nothing that YAML can do besides."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict

import yaml  # type: ignore[import-untyped]

from cflow_torch.data.json_file import MAX_DEPTH
from cflow_torch.data.paths import read_bytes
from cflow_torch.types import CFlowError

_MAX_BYTES = 1 << 17  # the settings of a run have 3 kB


def read_settings(file: Path) -> Dict[str, Any]:
    """What `write_config` wrote.

    Convention: no tags (which make objects), no anchors and aliases (a few lines of which can mean gigabytes), no
        interpolation: `${...}` is text here.

    Raises:
        CFlowError: too large, no YAML, another kind of file, or one with tags, anchors or aliases.
        OSError: as `read_bytes`.
    """
    data = read_bytes(file, _MAX_BYTES)
    try:
        value = plain_yaml(data.decode("utf-8"))
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise CFlowError(
            f"{file} holds no settings ({' '.join(str(error).split())[:200]}): give output=FOLDER, or remove it"
        ) from None
    if not isinstance(value, dict):
        raise CFlowError(f"{file} holds no settings, but {type(value).__name__}: give output=FOLDER, or remove it")
    return value


def plain_yaml(text: str) -> Any:
    """Values, lists and mappings of a YAML text.

    Raises:
        ValueError: it has tags, anchors or aliases, or is nested too deep.
        yaml.YAMLError: it is no YAML.
    """
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):
        if getattr(event, "anchor", None) is not None or getattr(event, "tag", None) is not None:
            raise ValueError("it has a tag, an anchor or an alias; settings have none")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise ValueError(f"lists or mappings are nested more than {MAX_DEPTH} deep")
    return yaml.safe_load(text)
