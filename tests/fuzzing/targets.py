"""All readers that are fuzzed, by name."""

from __future__ import annotations

from typing import Dict

from fuzzing import (
    arrow_targets,
    clouds_targets,
    hdf5_targets,
    json_targets,
    recorded_targets,
    settings_targets,
    zip_targets,
)
from fuzzing.target import Target

TARGETS: Dict[str, Target] = {
    target.name: target
    for module in (
        arrow_targets,
        clouds_targets,
        hdf5_targets,
        json_targets,
        recorded_targets,
        settings_targets,
        zip_targets,
    )
    for target in module.TARGETS
}
