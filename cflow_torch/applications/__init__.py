"""Applications of scene flow: tracks, clean logs and maps, training labels, streams, de-skewed points."""
