"""Our method: presets `default` and `offline`. Begin with `method.py`."""
