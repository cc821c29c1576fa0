"""AevaScenes reader (experimental)."""

from cflow_torch.data.aevascenes.reader import AevaScenesLog, find_aevascenes_sequences

__all__ = ["AevaScenesLog", "find_aevascenes_sequences"]
