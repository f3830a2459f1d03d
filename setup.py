"""What pyproject.toml cannot say: conf/ goes into the wheel as the data of qs3.conf."""

from setuptools import find_namespace_packages, find_packages, setup

setup(
    packages=[
        *find_packages(include=["qs3*"]),
        *(f"qs3.{name}" for name in find_namespace_packages(include=["conf*"])),
    ],
    package_dir={"qs3.conf": "conf"},
    package_data={"qs3": ["py.typed"], "": ["*.yaml"]},
)
