"""Which packages the wheel holds: those below cflow_torch/, and configs/ under the name cflow_torch.configs."""

from setuptools import find_packages, setup

own = find_packages(include=["cflow_torch", "cflow_torch.*"])
configs = [f"cflow_torch.configs.{name}" for name in find_packages("configs")]
setup(packages=[*own, "cflow_torch.configs", *configs])
