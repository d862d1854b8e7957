"""The packages of the distribution: the folder configs/ is installed as suspnet/configs."""

from setuptools import find_packages, setup

setup(
    packages=[*find_packages(include=["suspnet", "suspnet.*"]), "suspnet.configs"],
    package_dir={"suspnet.configs": "configs"},
    package_data={
        "suspnet": ["py.typed"],
        "suspnet.configs": ["**/*.yaml"],
        "suspnet.trips": ["report.html"],
    },
)
