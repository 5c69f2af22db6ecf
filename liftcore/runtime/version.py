"""The version of the library, which files and answers name."""

__version__ = "0.5.0"
