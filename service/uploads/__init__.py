"""How bytes become assets: received under a limit, checked in a process of their own, then kept."""
