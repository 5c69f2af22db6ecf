"""What splatlift measures about itself: run by hand (`python -m tests.benchmarks...`), never collected by pytest."""
