"""Fuzzing of the readers: what is fed to them (targets, mutation), what may come out (outcome), long runs (campaign)."""
