"""Batched tensor operations, independent of LiDAR."""
