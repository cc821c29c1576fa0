"""The paper's dense method: `method.py` is the page to read first."""
