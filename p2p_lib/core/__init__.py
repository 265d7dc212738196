"""Ground floor: values and maths. No disk, no plots, no third-party model."""
