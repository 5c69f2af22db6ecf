"""The service's gate: attacks on a running service by its commands and public HTTP alone. Its figures: record.md."""
