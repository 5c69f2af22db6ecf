"""Commands of ``splatlift`` that entry points announce: each file is one, as those of `liftcore.cli` are."""
