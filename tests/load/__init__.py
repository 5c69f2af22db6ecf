"""Load on a real server: what others may wait for while some are slow, and while a lift keeps the cores busy."""
