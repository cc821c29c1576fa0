"""Your own files, one point cloud per sweep: reader and writer, file formats, poses."""

from cflow_torch.data.arrays.reader import ArraysLog, find_array_logs
from cflow_torch.data.arrays.writer import write_array_log

__all__ = ["ArraysLog", "find_array_logs", "write_array_log"]
