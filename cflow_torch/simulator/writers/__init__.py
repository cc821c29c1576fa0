"""Simulated drives on disk, in the layouts of the data sets, so that readers have something to read."""
