"""A Mitsuba scene as the solvers see it, and the checks that it can be rendered."""
