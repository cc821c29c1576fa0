"""Ours, presets `default` and `offline`: motion candidates, verified; `method.py` is the page to read first."""
