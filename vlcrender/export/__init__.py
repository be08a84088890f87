"""Export of a dataset to the formats of other tools: one module a format; `registry` lists them.

docs/exporting.md states axes, pixel origin and units of each. `conventions` has the conversions, `source` reads the
dataset.
"""
