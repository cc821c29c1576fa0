"""Likely mistakes in sweeps and poses: under which reading does the static world stand still?"""
