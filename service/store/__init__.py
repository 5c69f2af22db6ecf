"""What the service remembers: SQLite for facts, files for bytes, all below one data directory."""
