"""The version, in a module without imports, so that nothing imports the package root for it."""

__all__ = ["__version__"]

__version__ = "0.1.0"
