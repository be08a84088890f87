"""Variants: one positioning method a module, their catalogue, and the registry of other packages' variants."""
