"""X: settings, accumulation of region weights, the closed form and its diagnostics."""
