"""CorrelationFlow as a model of OpenSceneFlow (SeFlow, DeltaFlow and their forks): no change in the checkout.

`python -m cflow_torch.integrations.opensceneflow FILE` writes the checkpoint without weights that its scripts ask for.
"""

from cflow_torch.integrations.opensceneflow.checkpoint import write_null_checkpoint
from cflow_torch.integrations.opensceneflow.module import CFlow

__all__ = ["CFlow", "write_null_checkpoint"]
