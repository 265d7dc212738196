"""One thin adapter per third-party model, imported only when asked for by name."""
