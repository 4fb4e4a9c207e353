"""The executables, one file each. Each has BLAS on one thread, which is set before a node imports NumPy."""

from modcal_nodes.one_thread import limit_blas

limit_blas()
