"""What pyproject.toml cannot say: package.xml has the version; config/ and msg/ are shipped."""

import re
from pathlib import Path

from setuptools import find_packages, setup

root = Path(__file__).parent
manifest = (root / "package.xml").read_text(encoding="utf-8")
version = re.search(r"<version>(.+)</version>", manifest)
assert version, "package.xml has no <version>"
settings = [
    str(path.relative_to(root / "config"))
    for path in sorted((root / "config").rglob("*"))
    if path.is_file()
]

setup(
    version=version[1],
    packages=[
        *find_packages(include=["vflatten_ros", "vflatten_ros.*"]),
        "vflatten_ros.config",
        "vflatten_ros.definitions",
    ],
    package_dir={"vflatten_ros.config": "config", "vflatten_ros.definitions": "msg"},
    package_data={"vflatten_ros.config": settings, "vflatten_ros.definitions": ["*.msg"]},
)
