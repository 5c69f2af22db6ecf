"""Commands of ``splatlift`` of the service: each file is one, as those of `liftcore.cli` are."""
