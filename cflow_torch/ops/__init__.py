"""Batched tensor operations that know nothing of LiDAR."""
