"""Model group for OpenSceneFlow: hydra.searchpath=[pkg://cflow_torch.configs.opensceneflow]."""
