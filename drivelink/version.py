"""The version: below everything else, so that nothing imports the package's root for it."""

__all__ = ["__version__"]

__version__ = "0.1.0"
