"""Folders of point clouds: reader and writer."""

from cflow_torch.data.arrays.folder import find_array_logs
from cflow_torch.data.arrays.reader import ArraysLog
from cflow_torch.data.arrays.writer import write_array_log

__all__ = ["ArraysLog", "find_array_logs", "write_array_log"]
