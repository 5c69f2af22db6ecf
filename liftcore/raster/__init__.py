"""A, one view at a time: projection, depth order, binning, blending, and the oracle they are held to."""
