"""The settings of the commands, found by Hydra as pkg://cflow_torch.configs."""
