"""The licence expression. In pyproject.toml, setuptools 75 rejects it, which is the newest for Python 3.8."""

import setuptools

NAME = "license_expression" if int(setuptools.__version__.split(".")[0]) >= 77 else "license"
setuptools.setup(**{NAME: "BSD-3-Clause"})
