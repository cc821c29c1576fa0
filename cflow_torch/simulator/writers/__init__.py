"""Write simulated drives as logs of Argoverse 2. `cflow_torch.data` writes any log as HDF5 scenes or arrays."""
