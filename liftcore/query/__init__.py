"""Words to splats: text encoders, scores, thresholds, attention maps and masks."""
