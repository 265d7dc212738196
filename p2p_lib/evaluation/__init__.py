"""Metrics, protocols, and the studies that notebooks show."""
