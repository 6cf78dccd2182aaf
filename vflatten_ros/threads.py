"""One thread for linear algebra, so that a result has the same bits on every machine.

BLAS splits sums by the number of threads, by default that of the cores, and sums split otherwise
round otherwise. The method's matrices are small: one thread is faster, too.
"""

from __future__ import annotations

import os

# OpenBLAS (wheels and Debian), its OpenMP build, MKL, BLIS, Accelerate
VARIABLES = (
    "OPENBLAS_NUM_THREADS",
    "OMP_NUM_THREADS",
    "MKL_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


def use_one() -> None:
    """Limit this process and those it starts, whatever the user's environment says.

    For our own commands and the node only, and before numpy is imported: the libraries read their
    variables when they are loaded. Who calls the package from Python decides for himself.
    """
    for name in VARIABLES:
        os.environ[name] = "1"
