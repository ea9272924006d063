"""Programs behind the published results: figures of the thesis, studies, benchmarks and fuzz tests. Not installed."""

import os

# Matrices here are small: several BLAS threads cost more time than they save. Set before NumPy is imported.
os.environ.setdefault("OMP_NUM_THREADS", "1")
