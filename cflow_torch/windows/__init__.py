"""What comes in: sweeps of windows, checked, in the frame of t+1, on one BEV grid."""
