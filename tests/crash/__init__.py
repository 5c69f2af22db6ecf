"""What the service promises when processes die, stop, are canceled, or the disk is full."""
