"""Local solve: the nearest minimum of E, with covariance, fit and unobservable motions (paper eqs 11, 12).

`placement` finds an initial translation, `descent` minimises the first-order residuals, `polish` the exact functions,
and `observability` describes in words what the measurements leave free. All below `local` and `observability` is
compiled.
"""

from fusion.solve.local import LocalSolution, local_solution, solve, solve_from_many

__all__ = ["LocalSolution", "local_solution", "solve", "solve_from_many"]
