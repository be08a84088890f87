"""Files of a dataset as datasets/FORMAT.md defines them: rows, tables, images, digests and locks."""
