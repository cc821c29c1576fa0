"""AevaScenes: reader and writer."""

from __future__ import annotations

from cflow_torch.data.aevascenes.reader import AevaScenesLog, find_aevascenes_sequences
from cflow_torch.data.aevascenes.writer import write_aevascenes_sequence

__all__ = ["AevaScenesLog", "find_aevascenes_sequences", "write_aevascenes_sequence"]
