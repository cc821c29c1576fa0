"""Simulated drives on disk, in the layouts of the data sets, so that readers have something to read.

What a writer makes takes its name when all of it is on disk; if it fails, what was there before stays.
"""
