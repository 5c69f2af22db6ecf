"""Speed against accuracy on a scene of the user's: the dial and the presets, measured under a budget of time."""
