"""The license: pyproject.toml has no form of it that the setuptools of Python 3.8 and of today both accept."""

from setuptools import setup

setup(license="BSD-3-Clause")
