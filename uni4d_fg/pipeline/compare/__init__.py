"""Solvers side by side: the same energies from the same starts, timed, scored and drawn."""
