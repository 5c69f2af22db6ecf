"""Measurements of splatlift: scripts that are run by hand (`python -m tests.benchmarks.NAME`), never by pytest."""
