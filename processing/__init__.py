"""From frames to shape, poses and a contact model.

Libraries that would start a thread per core do their work in one: stages are what runs side by side, and their results
do not depend on how many cores there are. They look once, when they are loaded, so this stands before all imports.
"""

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(_name, "1")

import recordings  # noqa: E402, F401 (names a place for compiled kernels, before numba is loaded)
