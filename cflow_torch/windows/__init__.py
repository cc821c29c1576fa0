"""Input: check the sweeps of windows, say how they may be read, bring them into the frame of t+1, collate batches."""
