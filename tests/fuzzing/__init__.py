"""Fuzzing of the readers: what they are fed (targets, mutation), what may come of it (outcome), long runs."""
