"""Files of the field to values and back."""
