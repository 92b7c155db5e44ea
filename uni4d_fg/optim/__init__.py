"""Problems made of factors, and what minimizes them: Levenberg-Marquardt with its linear solvers, and Adam.

The fast linear solvers know the structure of bundle adjustment (landmarks, pairs of cameras) and of trajectories.
Covariances and marginalization are here as well. Nothing here knows of videos, tracks or files.
"""
