"""A model for OpenSceneFlow (SeFlow, DeltaFlow and their forks) that needs no change in the checkout.

`python -m cflow_torch.integrations.opensceneflow FILE` writes the checkpoint without weights that its scripts require.
"""

from cflow_torch.integrations.opensceneflow.module import CFlow, write_null_checkpoint

__all__ = ["CFlow", "write_null_checkpoint"]
