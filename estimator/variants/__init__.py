"""Variants: one positioning method a module, their catalogue, and the registry of methods from other packages."""
