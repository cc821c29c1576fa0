"""A model for OpenSceneFlow (SeFlow, DeltaFlow and their forks) that needs no change in the checkout.

OpenSceneFlow requires a checkpoint. `python -m cflow_torch.integrations.opensceneflow FILE` writes one without weights.
"""

from cflow_torch.integrations.opensceneflow.module import CFlow, write_null_checkpoint

__all__ = ["CFlow", "write_null_checkpoint"]
