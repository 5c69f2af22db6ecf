"""Promises of splatlift, by public names, the command line and HTTP alone: they hold whatever the inside becomes."""
