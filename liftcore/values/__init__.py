"""Values of a lift and their files: views and packs, settings, region weights, the record of what was lifted."""
