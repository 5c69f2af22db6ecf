"""How jobs run: one supervisor thread, one child process a job."""
