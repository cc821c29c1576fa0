"""The licence expression, for which setuptools has a name from version 77 on. All else is in pyproject.toml."""

import setuptools

NAME = "license_expression" if int(setuptools.__version__.split(".")[0]) >= 77 else "license"
setuptools.setup(**{NAME: "BSD-3-Clause"})
