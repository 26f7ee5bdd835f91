"""Fits and diagnoses many recordings of many joints on Dask, and detects changes.

Needs the extra `fleet`; nothing else of the service imports this package.
"""
