"""Benchmark: the method against its reference and against a plain OpenCV loop."""
