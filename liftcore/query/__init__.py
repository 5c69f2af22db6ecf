"""Words and examples to splats: text encoders, scores, thresholds, objects, masks and pictures."""
