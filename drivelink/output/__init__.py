"""Output: atomic files, plots, progress, reports."""
