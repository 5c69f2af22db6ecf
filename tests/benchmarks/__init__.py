"""What splatlift measures about itself: scripts run by hand (`python -m tests.benchmarks.NAME`), never by pytest."""
