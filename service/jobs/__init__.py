"""How jobs run: a supervisor thread and a child process for each that runs."""
