"""Solvers: distances and spots into positions, by trilateration, collinearity, stereo or reprojection error."""
