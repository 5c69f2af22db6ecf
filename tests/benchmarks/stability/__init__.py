"""The extremes: each is a case that a command measures into ``docs/stability.md`` and that a test holds."""
