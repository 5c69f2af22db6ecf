"""Ways to lift that others take, on the same work as ours: side by side, checked and timed."""
