# mpiexec -n 2 python demos/case_a_mpi.py
"""Case A shared by any number of ranks: the same script, and the same figures, as on one."""

from mpi4py import MPI

from rich import print

from extrusion import cases, run

result = run(cases.A)
if MPI.COMM_WORLD.rank == 0:
    print(result.table())
assert all(figure.ok for figure in result.figures()), result.error
