"""Our method: presets `default`, `offline` and `live`. Begin with `method.py`."""
