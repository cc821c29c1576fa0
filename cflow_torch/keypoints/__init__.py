"""The paper's key-point variant: `method.py` is the page to read first."""
