"""What is made of flow: labels, static sweeps, tracks, streams."""
