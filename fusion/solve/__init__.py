"""From a start to the nearest minimum of E, with covariance, fit and what stays free (paper eqs 11, 12).

`placement` finds a translation to start from, `descent` goes down the rows, `polish` ends on the exact functions, and
`observability` says in words what the measurements leave free. All below `local` and `observability` is compiled.
"""

from fusion.solve.local import LocalSolution, local_solution, solve, solve_from_many

__all__ = ["LocalSolution", "local_solution", "solve", "solve_from_many"]
