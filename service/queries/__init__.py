"""How queries run: one warm worker process that keeps lifts mapped and encoders loaded."""
