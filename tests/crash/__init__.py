"""Promises of the service when processes die, stop or are canceled, or the disk is full."""
