"""Ours, presets `default` and `fast`: motion candidates, verified; `method.py` is the page to read first."""
