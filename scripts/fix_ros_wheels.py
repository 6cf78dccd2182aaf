#!/usr/bin/env python3
"""Make the ROS wheels of this interpreter's environment usable for building interfaces.

Two things in the CMake files that the wheels install do not hold on another machine:

- The exported targets name the folders where the headers of Python and NumPy were on the machine
  that built the wheels.
- The Python generator exports NumPy's header folder. CMake refuses to export a folder that lies
  inside the source tree, which is where .venv is; `BUILD_INTERFACE` keeps it out of the export.

Running it again changes nothing.
"""

import re
import sys
import sysconfig
from pathlib import Path

import numpy

NUMPY_HEADERS = re.compile(r'/opt/python/[^;"]+/numpy/_?core/include')
PYTHON_HEADERS = re.compile(r'/opt/python/[^;"]+/include/python[\d.]+t?')
NUMPY_EXPORT = " ${Python3_NumPy_INCLUDE_DIRS})"
NUMPY_BUILD_ONLY = ' "$<BUILD_INTERFACE:${Python3_NumPy_INCLUDE_DIRS}>")'


def fixed(text: str) -> str:
    """The CMake file with this machine's header folders."""
    text = NUMPY_HEADERS.sub(lambda _: numpy.get_include(), text)
    text = PYTHON_HEADERS.sub(lambda _: sysconfig.get_path("include"), text)
    return text.replace(NUMPY_EXPORT, NUMPY_BUILD_ONLY)


def main() -> None:
    """Rewrite every exported CMake file below the environment's share folder."""
    for path in sorted(Path(sys.prefix, "share").glob("*/cmake/*.cmake")):
        before = path.read_text(encoding="utf-8")
        after = fixed(before)
        if after != before:
            path.write_text(after, encoding="utf-8")


if __name__ == "__main__":
    main()
