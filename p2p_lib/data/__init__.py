"""Frames in, files out: loaders, synthetic sequences, manifests, runs on disk, cameras."""
