"""Report: one self-contained HTML page of a dataset alone, for people."""
