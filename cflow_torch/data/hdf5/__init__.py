"""OpenSceneFlow's HDF5 scenes: reader, writer, results."""

from cflow_torch.data.hdf5.reader import HDF5Log, find_hdf5_scenes
from cflow_torch.data.hdf5.writer import write_hdf5_results, write_hdf5_scene

__all__ = ["HDF5Log", "find_hdf5_scenes", "write_hdf5_results", "write_hdf5_scene"]
