"""The commands of ``splatlift``, one a file: ``run(options)`` works and returns the exit status."""
