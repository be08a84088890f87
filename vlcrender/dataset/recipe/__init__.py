"""Recipes: what a dataset is to be, from TOML to a plan of poses, exposures and cells of sweeps."""
