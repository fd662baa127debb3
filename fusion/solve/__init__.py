"""Finds the nearest minimum of E, with covariance, fit and unobservable motions (paper eqs 11, 12).

`placement` finds an initial translation, `descent` minimises the first-order residuals, `polish` the exact functions,
and `observability` describes in words the motions that the measurements do not determine. The modules other than `local`
and `observability` are compiled.
"""

from fusion.solve.local import LocalSolution, local_solution, solve, solve_from_many

__all__ = ["LocalSolution", "local_solution", "solve", "solve_from_many"]
