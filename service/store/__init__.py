"""The store: SQLite for records and files for bytes, all below one data directory."""
