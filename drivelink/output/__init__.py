"""What people are shown and what is left on disk: files written whole, plots, progress, reports."""
