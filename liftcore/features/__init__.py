"""B = S E: what a view observes, as regions or grids over a codebook, and the files that hold it."""
