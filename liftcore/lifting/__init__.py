"""A lift from its inputs to its result: the plan, the geometry phase, the solution, and who works on it."""
