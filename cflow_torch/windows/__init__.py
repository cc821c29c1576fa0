"""Input: check the sweeps of windows, bring them into the frame of t+1, collate batches."""
